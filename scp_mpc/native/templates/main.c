/* A robot drives to a goal 5 m ahead, past an obstacle that comes towards it. */
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "@name@.h"

static char memory[@NAME@_BYTES + 64];

/* A robot's own clock is better: this one tells the processor's time. */
static double seconds(void *context)
{
    (void)context;
    return (double)clock() / CLOCKS_PER_SEC;
}

/* An obstacle at constant speed, less and less certain. Row 0 is now. */
static void predict(const scp_problem *problem, double now, double *means, double *covariances)
{
    int d = problem->dim;
    for (int i = 0; i <= problem->horizon; i++, means += d, covariances += d * d) {
        memset(means, 0, (size_t)d * sizeof *means);
        memset(covariances, 0, (size_t)(d * d) * sizeof *covariances);
        means[0] = 4 - 0.3 * (now + i * problem->dt);
        means[1] = 0.1;
        for (int k = 0; k < d; k++)
            covariances[k * d + k] = 0.01 + 0.001 * i;
    }
}

int main(void)
{
    scp_problem problem;
    @name@_problem(&problem);
    problem.clock = seconds;
    scp_core *core = scp_setup(&problem, memory + (64 - (uintptr_t)memory % 64) % 64, @NAME@_BYTES);
    if (!core) {
        printf("wrong: %s\n", scp_name(scp_check(&problem)));
        return 1;
    }
    scp_inputs *in = scp_in(core);
    const scp_outputs *out = scp_out(core);
    int nx = problem.nx, x = problem.position[0];
    for (int i = 0; i <= problem.horizon; i++)
        in->x_ref[i * nx + x] = 5; /* all else is zero, like the state in the beginning */
    in->count = problem.max_obstacles > 0;
    if (in->count)
        in->radii[0] = 0.2;
    for (int step = 0; step < 50; step++) {
        if (in->count)
            predict(&problem, step * problem.dt, in->means, in->covariances);
        int wrong = scp_step(core);
        if (wrong) {
            printf("wrong: %s\n", scp_input_name(wrong));
            return 1;
        }
        printf("%5.2f s  at %6.3f %6.3f  status %d  u", step * problem.dt, in->x0[x],
               in->x0[problem.position[1]], (int)out->status);
        for (int k = 0; k < problem.nu; k++)
            printf(" %7.3f", out->u0[k]);
        printf("\n");
        /* out->u0 goes to the motors here, and the next state comes from the sensors */
        memcpy(in->x0, out->plan.states + nx, (size_t)nx * sizeof *in->x0);
    }
    return 0;
}
