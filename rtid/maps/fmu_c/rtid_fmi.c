/* The functions of FMI 2.0 and 3.0 for co-simulation around a learned machine: -DFMI_VERSION=2 or 3.
 *
 * Value references are places in Machine.real, and behind them the integers.
 */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "rtid_machine.h"

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define PASTED(a, b) a##b
#define JOINED(a, b) PASTED(a, b)
#if FMI_VERSION == 2
#define F(name) JOINED(fmi2, name)
#define STATE(begin, end) F(begin##FMUstate##end)
typedef int Flag;
#else
#define F(name) JOINED(fmi3, name)
#define STATE(begin, end) F(begin##FMUState##end)
typedef bool Flag;
#endif
#define NOT_HERE(name) EXPORT int F(name)() { return FAILED; }
#define DONE(name) EXPORT int F(name)() { return OK; }

enum { OK = 0, DISCARDED = 2, FAILED = 3 };
typedef uint32_t Reference;

static void *created(const char *token) {
    Machine *m = token && strcmp(token, TOKEN) == 0 ? malloc(sizeof(Machine)) : NULL;
    if (m) machine_reset(m);
    return m;
}

static int get_reals(Machine *m, const Reference *at, size_t n, double *values) {
    machine_outputs(m);
    for (size_t k = 0; k < n; k++) {
        if (at[k] >= N_REAL) return FAILED;
        values[k] = m->real[at[k]];
    }
    return OK;
}

static int set_reals(Machine *m, const Reference *at, size_t n, const double *values) {
    for (size_t k = 0; k < n; k++) {
        if (at[k] >= AT_FLOW || at[k] == AT_TIME) return FAILED;
        m->real[at[k]] = values[k];
    }
    m->is_old = 1;
    return OK;
}

static int get_whole(Machine *m, const Reference *at, size_t n, int32_t *values) {
    machine_outputs(m);
    for (size_t k = 0; k < n; k++) {
        if (at[k] < AT_STATUS || at[k] >= N_ALL) return FAILED;
        values[k] = m->whole[at[k] - AT_STATUS];
    }
    return OK;
}

/* A step; one that ran away leaves the machine as it was. */
static int stepped(Machine *m, double time, double dt) {
    Machine before = *m;
    m->real[AT_TIME] = time;
    if (dt >= 0.0 && machine_step(m, dt) != RAN_AWAY) return OK;
    *m = before;
    return dt >= 0.0 ? DISCARDED : FAILED;
}

EXPORT const char *F(GetVersion)(void) { return FMI_VERSION == 2 ? "2.0" : "3.0"; }
EXPORT void F(FreeInstance)(void *m) { free(m); }
EXPORT int F(Reset)(void *m) { machine_reset(m); return OK; }
DONE(SetDebugLogging)
DONE(ExitInitializationMode)
DONE(Terminate)
NOT_HERE(GetDirectionalDerivative)

EXPORT int STATE(Get, )(void *m, void **state) {
    if (!*state) *state = malloc(sizeof(Machine));
    if (!*state) return FAILED;
    memcpy(*state, m, sizeof(Machine));
    return OK;
}
EXPORT int STATE(Set, )(void *m, void *state) { memcpy(m, state, sizeof(Machine)); return OK; }
EXPORT int STATE(Free, )(void *m, void **state) {
    (void)m;
    free(*state);
    *state = NULL;
    return OK;
}
EXPORT int STATE(Serialized, Size)(void *m, void *state, size_t *size) {
    (void)m, (void)state;
    *size = sizeof(Machine);
    return OK;
}
EXPORT int STATE(Serialize, )(void *m, void *state, uint8_t *bytes, size_t size) {
    (void)m;
    if (size != sizeof(Machine)) return FAILED;
    memcpy(bytes, state, size);
    return OK;
}

#if FMI_VERSION == 2
EXPORT int fmi2DeSerializeFMUstate(void *m, const uint8_t *bytes, size_t size, void **state) {
    (void)m;
    return size == sizeof(Machine) ? fmi2GetFMUstate((void *)bytes, state) : FAILED;
}
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT void *fmi2Instantiate(const char *name, int type, const char *token, const char *place,
                             const void *callbacks, int visible, int logs) {
    (void)name, (void)place, (void)callbacks, (void)visible, (void)logs;
    return type == 1 ? created(token) : NULL;
}
EXPORT int fmi2SetupExperiment(Machine *m, int has_tolerance, double tolerance, double begin_s,
                               int has_end, double end_s) {
    (void)has_tolerance, (void)tolerance, (void)has_end, (void)end_s;
    m->real[AT_TIME] = begin_s;
    return OK;
}
DONE(EnterInitializationMode)
EXPORT int fmi2GetReal(Machine *m, const Reference *at, size_t n, double *values) {
    return get_reals(m, at, n, values);
}
EXPORT int fmi2SetReal(Machine *m, const Reference *at, size_t n, const double *values) {
    return set_reals(m, at, n, values);
}
EXPORT int fmi2GetInteger(Machine *m, const Reference *at, size_t n, int32_t *values) {
    return get_whole(m, at, n, values);
}
EXPORT int fmi2SetRealInputDerivatives(Machine *m, const Reference *at, size_t n, const int *order,
                                       const double *values) {
    for (size_t k = 0; k < n; k++) {
        if (order[k] != 1 || at[k] < AT_SIGNAL || at[k] >= AT_RATE) return FAILED;
        m->real[at[k] + AT_RATE - AT_SIGNAL] = values[k];
    }
    return OK;
}
EXPORT int fmi2DoStep(Machine *m, double time, double dt, int is_final) {
    (void)is_final;
    return stepped(m, time, dt);
}
EXPORT int fmi2GetRealStatus(Machine *m, int kind, double *value) {
    *value = m->real[AT_TIME];
    return kind == 2 ? OK : DISCARDED;
}
EXPORT int fmi2GetBooleanStatus(Machine *m, int kind, int *value) {
    (void)m;
    *value = 1; /* asked for after a step that was discarded: the run has ended */
    return kind == 3 ? OK : DISCARDED;
}
NOT_HERE(SetInteger)
NOT_HERE(GetBoolean)
NOT_HERE(SetBoolean)
NOT_HERE(GetString)
NOT_HERE(SetString)
NOT_HERE(GetRealOutputDerivatives)
NOT_HERE(CancelStep)
NOT_HERE(GetStatus)
NOT_HERE(GetIntegerStatus)
NOT_HERE(GetStringStatus)
#else
EXPORT int fmi3DeserializeFMUState(void *m, const uint8_t *bytes, size_t size, void **state) {
    (void)m;
    return size == sizeof(Machine) ? fmi3GetFMUState((void *)bytes, state) : FAILED;
}
EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *place,
                                         Flag visible, Flag logs, Flag has_events, Flag may_return,
                                         const Reference *between, size_t n, void *environment,
                                         void *log, void *update) {
    (void)name, (void)place, (void)visible, (void)logs, (void)has_events, (void)may_return;
    (void)between, (void)n, (void)environment, (void)log, (void)update;
    return created(token);
}
EXPORT void *fmi3InstantiateModelExchange() { return NULL; }
EXPORT void *fmi3InstantiateScheduledExecution() { return NULL; }
EXPORT int fmi3EnterInitializationMode(Machine *m, Flag has_tolerance, double tolerance,
                                       double begin_s, Flag has_end, double end_s) {
    (void)has_tolerance, (void)tolerance, (void)has_end, (void)end_s;
    m->real[AT_TIME] = begin_s;
    return OK;
}
EXPORT int fmi3GetFloat64(Machine *m, const Reference *at, size_t n, double *values, size_t size) {
    return n == size ? get_reals(m, at, n, values) : FAILED;
}
EXPORT int fmi3SetFloat64(Machine *m, const Reference *at, size_t n, const double *values,
                          size_t size) {
    return n == size ? set_reals(m, at, n, values) : FAILED;
}
EXPORT int fmi3GetInt32(Machine *m, const Reference *at, size_t n, int32_t *values, size_t size) {
    return n == size ? get_whole(m, at, n, values) : FAILED;
}
EXPORT int fmi3DoStep(Machine *m, double time, double dt, Flag is_final, Flag *has_event,
                      Flag *is_over, Flag *is_early, double *reached_s) {
    (void)is_final;
    int code = stepped(m, time, dt);
    *has_event = *is_early = false;
    *is_over = code == DISCARDED;
    *reached_s = code == OK ? time + dt : time;
    return code;
}
DONE(EnterConfigurationMode)
DONE(ExitConfigurationMode)
DONE(EnterStepMode)
NOT_HERE(EnterEventMode)
NOT_HERE(UpdateDiscreteStates)
NOT_HERE(EvaluateDiscreteStates)
NOT_HERE(GetOutputDerivatives)
NOT_HERE(GetAdjointDerivative)
NOT_HERE(GetNumberOfVariableDependencies)
NOT_HERE(GetVariableDependencies)
NOT_HERE(GetFloat32)
NOT_HERE(SetFloat32)
NOT_HERE(GetInt8)
NOT_HERE(SetInt8)
NOT_HERE(GetUInt8)
NOT_HERE(SetUInt8)
NOT_HERE(GetInt16)
NOT_HERE(SetInt16)
NOT_HERE(GetUInt16)
NOT_HERE(SetUInt16)
NOT_HERE(SetInt32)
NOT_HERE(GetUInt32)
NOT_HERE(SetUInt32)
NOT_HERE(GetInt64)
NOT_HERE(SetInt64)
NOT_HERE(GetUInt64)
NOT_HERE(SetUInt64)
NOT_HERE(GetBoolean)
NOT_HERE(SetBoolean)
NOT_HERE(GetString)
NOT_HERE(SetString)
NOT_HERE(GetBinary)
NOT_HERE(SetBinary)
NOT_HERE(GetClock)
NOT_HERE(SetClock)
NOT_HERE(GetIntervalDecimal)
NOT_HERE(SetIntervalDecimal)
NOT_HERE(GetIntervalFraction)
NOT_HERE(SetIntervalFraction)
NOT_HERE(GetShiftDecimal)
NOT_HERE(SetShiftDecimal)
NOT_HERE(GetShiftFraction)
NOT_HERE(SetShiftFraction)
NOT_HERE(EnterContinuousTimeMode)
NOT_HERE(CompletedIntegratorStep)
NOT_HERE(SetTime)
NOT_HERE(SetContinuousStates)
NOT_HERE(GetContinuousStateDerivatives)
NOT_HERE(GetEventIndicators)
NOT_HERE(GetContinuousStates)
NOT_HERE(GetNominalsOfContinuousStates)
NOT_HERE(GetNumberOfEventIndicators)
NOT_HERE(GetNumberOfContinuousStates)
NOT_HERE(ActivateModelPartition)
#endif
