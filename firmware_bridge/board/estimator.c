/* Samples of samples.bin through the estimator on the board.  To out.bin: counts of each update
 * less those of an empty measurement, then the settled sums, the solution and the memory. */
#include "board.h"

#include "rtid_estimator_sums.h"

static rtid_estimator e;
static rtid_estimator_work work;
static rtid_estimator_solution solution;
static rtid_estimator_sample samples[256];
static uint32_t counts[256];

static uint32_t since(uint32_t start) { return (start - board_now()) & 0xFFFFFFu; }

int main(void)
{
    const int in = board_open("samples.bin", READ), out = board_open("out.bin", WRITE);
    size_t n;
    if (in < 0 || out < 0)
        return 1;
    rtid_estimator_start(&e);
    while ((n = board_read(in, samples, sizeof samples) / sizeof *samples) > 0) {
        for (size_t k = 0; k < n; k++) {
            const uint32_t start = board_now();
            (void)rtid_estimator_update(&e, &samples[k]);
            counts[k] = since(start);
        }
        board_write(out, counts, n * sizeof *counts);
    }
    rtid_estimator_freeze(&e, &work);
    rtid_est_settle(&work);
    board_write(out, work.matrix, sizeof work.matrix);
    rtid_estimator_freeze(&e, &work);
    rtid_estimator_solve(&work, &solution);
    board_write(out, &solution, sizeof solution);
    board_write(out, &e, sizeof e);
    return 0;
}
