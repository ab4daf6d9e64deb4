/* Samples from standard input through the estimator; verdicts, memory and solution to standard
 * output, all as the host's own records.  With a number N it is also asked every N samples. */
#include <stdio.h>
#include <stdlib.h>

#include "rtid_estimator_sums.h"

static rtid_estimator e;
static rtid_estimator_work work;

static void put(const void *bytes, size_t n) { fwrite(bytes, 1, n, stdout); }

int main(int argc, char **argv)
{
    const long every = argc > 1 ? atol(argv[1]) : 0;
    long taken = 0;
    rtid_estimator_sample sample;
    rtid_estimator_solution solution;
    const uint64_t sizes[] = {sizeof e, sizeof work, sizeof sample, sizeof solution};
    rtid_estimator_start(&e);
    put(sizes, sizeof sizes);
    while (fread(&sample, sizeof sample, 1, stdin) == 1) {
        const int8_t verdict = (int8_t)rtid_estimator_update(&e, &sample);
        put(&verdict, 1);
        if (every > 0 && ++taken % every == 0) {
            rtid_estimator_freeze(&e, &work);
            rtid_estimator_solve(&work, &solution);
        }
    }
    rtid_estimator_freeze(&e, &work);
    put(&e, sizeof e);
    rtid_est_settle(&work);
    put(work.matrix, sizeof work.matrix);
    rtid_estimator_freeze(&e, &work);
    rtid_estimator_solve(&work, &solution);
    put(&work, sizeof work);
    put(&solution, sizeof solution);
    return 0;
}
