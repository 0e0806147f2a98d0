/* Makes the control steps of vectors.c anew and compares: to 1e-9, or bit by bit with --bits. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "@name@.h"
#include "vectors.h"

static char memory[@NAME@_BYTES + 64];
static double apart; /* largest difference, relative where numbers are large */
static int bits;     /* whether all of a step's are the same */

static void compare(const double *found, const double *expected, int count)
{
    for (int i = 0; i < count; i++) {
        double off = fabs(found[i] - expected[i]) / fmax(1, fabs(expected[i]));
        if (!(off <= apart) && !isnan(apart)) /* no number is the largest of all */
            apart = off;
    }
    bits = bits && !(count && memcmp(found, expected, (size_t)count * sizeof *found));
}

static void write(const scp_problem *problem, const vector *given, scp_inputs *in)
{
    size_t N = (size_t)problem->horizon, nx = (size_t)problem->nx, d = (size_t)problem->dim;
    size_t J = (size_t)given->count, number = sizeof(double);
    memcpy(in->x0, given->x0, nx * number);
    memcpy(in->x_ref, given->x_ref, (N + 1) * nx * number);
    in->count = given->count;
    if (!J)
        return;
    memcpy(in->means, given->means, J * (N + 1) * d * number);
    memcpy(in->covariances, given->covariances, J * (N + 1) * d * d * number);
    memcpy(in->radii, given->radii, J * number);
    memcpy(in->shape, given->shape, J * sizeof(int));
}

static void write_box(const scp_problem *problem, scp_inputs *in)
{
    size_t d = (size_t)problem->dim, number = sizeof(double);
    in->shapes = box.corners > 0;
    if (!in->shapes)
        return;
    in->corners[0] = box.corners;
    in->faces[0] = box.faces;
    in->edges[0] = box.edges;
    memcpy(in->corner, box.corner, (size_t)box.corners * d * number);
    memcpy(in->normal, box.normal, (size_t)box.faces * d * number);
    memcpy(in->offset, box.offset, (size_t)box.faces * number);
    memcpy(in->edge, box.edge, (size_t)box.edges * 2 * sizeof(int));
}

int main(int count, char **words)
{
    int wanted = count > 1 && !strcmp(words[1], "--bits"), same = 0, wrong = 0;
    scp_problem problem;
    @name@_problem(&problem);
    scp_core *core = scp_setup(&problem, memory + (64 - (uintptr_t)memory % 64) % 64, @NAME@_BYTES);
    if (!core) {
        printf("no core in %d bytes of %lu\n", (int)@NAME@_BYTES, (unsigned long)scp_size(&problem));
        return 1;
    }
    scp_inputs *in = scp_in(core);
    const scp_outputs *out = scp_out(core);
    int N = problem.horizon;
    write_box(&problem, in);
    for (int k = 0; k < STEPS; k++) {
        const vector *v = vectors + k;
        write(&problem, v, in);
        int refused = scp_step(core);
        bits = 1;
        compare(out->plan.states, v->states, (N + 1) * problem.nx);
        compare(out->plan.inputs, v->inputs, N * problem.nu);
        compare(out->plan.s, v->s, v->count);
        compare(&out->cost, &v->cost, 1);
        same += bits;
        if (refused || (int)out->status != v->status) {
            printf("step %d: refused \"%s\", status %d, not %d\n", k, scp_input_name(refused),
                   (int)out->status, v->status);
            wrong = 1;
        }
    }
    printf("%d steps, %d the same bit by bit, at most %.3g apart\n", STEPS, same, apart);
    return wrong || !(apart <= 1e-9) || (wanted && same < STEPS);
}
