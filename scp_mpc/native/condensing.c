/* Condensing: the dynamics eliminated, in coordinates in which the cost is a circle;
 * scp/condensing.py, and layout.py's outputs.
 *
 * Constraints act on the outputs y of a plan only. Every plan that obeys the dynamics, linearised
 * about the present plan where they are nonlinear, is
 *
 *     y = y_free + S v,        cost = least + |v|^2 / 2
 *
 * where y_free is the plan that nothing constrains. Python takes v from a Cholesky factor of the
 * dense Hessian, here it comes from a Riccati pass (riccati.c): the same but for a rotation.
 *
 * Plans are always rolled out, so that there are no defects. Rolling out is Newton's method on all
 * stages at once, x <- x + D^-1 (f(x, u) - x_next), which for a linear robot takes one step.
 *
 *     e       (N, nx) deviations x_i - xref_i, i = 1 .. N; de, du changes of deviations and inputs
 *     D       block bidiagonal, unit diagonal, -A below:  D e = B u + drift
 */
#include <float.h>

#include "core.h"

enum { ROUNDS = 4 };                               /* of Newton's method, before stage by stage */
static const double CLOSED = 1e-12;                /* defect that is none */
static const double ROUNDINGS = 4 * DBL_EPSILON;   /* likewise, of the largest state */

void lay_out_condensing(scp_core *core, arena *from)
{
    core->reach = ints(from, (size_t)core->at.ny);
    if (!core->linear)
        return;
    lay_out_derivatives(core, from, &core->always);
    lay_out_sensitivity(core, from, &core->always_by);
    core->drift = doubles(from, (size_t)(core->at.N * core->at.nx));
}

/* ---- outputs */

/* y (ny,); no last input counts as zero. */
static void write_outputs(const scp_core *core, const double *p, const double *s, const double *u,
                          const double *u_last, const double *e, double *y)
{
    const layout *at = &core->at;
    copy_doubles(at->nodes.size * at->d, p, y + at->p);
    copy_doubles(at->M, s, y + at->s);
    copy_doubles(at->n, u, y + at->u);
    for (int i = 0; i < at->rated; i++) {
        double before = i >= at->nu ? u[i - at->nu] : u_last ? u_last[i] : 0;
        y[at->du + i] = u[i] - before;
    }
    double *z = y + at->z;
    memset(z, 0, (size_t)(at->N * at->nb) * sizeof(double));
    for (int i = 0; i < at->N && at->nb; i++, z += at->nb)
        add_product(at->nb, at->nx, core->p.row, e + i * at->nx, z);
}

void outputs_of(const scp_core *core, const double *p, const double *s, const double *u,
                const double *e, double *y)
{
    write_outputs(core, p, s, u, core->now->u_last, e, y);
}

/* ---- set-up and steps */

void set_up_condensing(scp_core *core)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu;
    for (int k = 0; k < at->nodes.size * at->d; k++)
        core->reach[at->p + k] = (k / at->d / at->nodes.count + 1) * nu;
    for (int j = 0; j < at->M; j++)
        core->reach[at->s + j] = 0;
    for (int k = 0; k < at->n; k++)
        core->reach[at->u + k] = (k / nu + 1) * nu;
    for (int k = 0; k < at->rated; k++)
        core->reach[at->du + k] = (k / nu + 1) * nu;
    for (int k = 0; k < at->N * at->nb; k++)
        core->reach[at->z + k] = (k / at->nb + 1) * nu;
    if (!core->linear)
        return;
    size_t used = core->scratch.used;
    double *X = doubles(&core->scratch, (size_t)((at->N + 1) * nx));
    double *p = doubles(&core->scratch, (size_t)(at->nodes.size * at->d));
    memset(X, 0, (size_t)((at->N + 1) * nx) * sizeof(double));
    double *U = doubles(&core->scratch, (size_t)at->n);
    memset(U, 0, (size_t)at->n * sizeof(double));
    for (int i = 0; i < at->N; i++) {
        copy_doubles(nx * nx, core->p.A, core->always.A + i * nx * nx);
        copy_doubles(nx * nu, core->p.B, core->always.B + i * nx * nu);
    }
    nodes_derivatives(core, at->nodes, X, U, p, &core->always);
    core->broken = sensitivity_along(core, &core->always, &core->always_by);
    core->scratch.used = used;
}

void begin_condensing(scp_core *core)
{
    int nx = core->at.nx;
    const double *x_ref = core->now->x_ref;
    for (int i = 0; core->linear && i < core->at.N; i++) {
        double *drift = core->drift + i * nx;
        for (int k = 0; k < nx; k++)
            drift[k] = -x_ref[(i + 1) * nx + k];
        add_product(nx, nx, core->p.A, i ? x_ref + i * nx : core->now->x0, drift);
    }
}

/* Close the defects of states X (N+1, nx) in place, A and B along them; 0 if that succeeds. */
static int closed(scp_core *core, double *X, const double *U, double *after, rollout *roll)
{
    int N = core->at.N, nx = core->at.nx;
    double before = HUGE_VAL;
    for (int round = 0; round < ROUNDS; round++) {
        if (model_linearise(core, N, X, U, 1.0, after, roll->along.A, roll->along.B))
            return 1;
        for (int k = 0; k < N * nx; k++)
            after[k] -= X[nx + k];
        double worst = largest_abs(N * nx, after);
        if (worst <= CLOSED + ROUNDINGS * largest_abs((N + 1) * nx, X))
            return 0;
        if (!(worst < before)) /* or NaN */
            return 1;
        before = worst;
        derivatives_roll(core, &roll->along, after);
        axpy(N * nx, 1, after, X + nx);
    }
    return 1;
}

/* Walk through the stages one by one. */
static int walked(scp_core *core, double *X, const double *U, double *after, rollout *roll)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu, failed = 0;
    for (int i = 0; i < N && !failed; i++)
        failed = model_step(core, X + i * nx, U + i * nu, X + (i + 1) * nx);
    return failed || model_linearise(core, N, X, U, 1.0, after, roll->along.A, roll->along.B);
}

int roll_out(scp_core *core, const double *U, const double *guess_e, rollout *roll)
{
    const layout *at = &core->at;
    const double *x_ref = core->now->x_ref, *x0 = core->now->x0;
    int N = at->N, nx = at->nx, nu = at->nu, failed = 0;
    size_t used = core->scratch.used;
    double *X = doubles(&core->scratch, (size_t)((N + 1) * nx));
    double *after = doubles(&core->scratch, (size_t)(N * nx)), *e = roll->e;
    copy_doubles(at->n, U, roll->u);
    copy_doubles(nx, x0, X);
    if (core->linear) {
        roll->along = core->always;
        copy_doubles(N * nx, core->drift, e);
        for (int i = 0; i < N; i++) {
            if (i)
                add_product(nx, nx, core->p.A, e + (i - 1) * nx, e + i * nx);
            add_product(nx, nu, core->p.B, U + i * nu, e + i * nx);
        }
        for (int k = 0; k < N * nx; k++)
            X[nx + k] = x_ref[nx + k] + e[k];
        nodes_positions(core, at->nodes, X, U, roll->p);
    } else {
        for (int k = 0; guess_e && k < N * nx; k++)
            X[nx + k] = x_ref[nx + k] + guess_e[k];
        if (!guess_e || closed(core, X, U, after, roll))
            failed = walked(core, X, U, after, roll);
        failed = failed || nodes_derivatives(core, at->nodes, X, U, roll->p, &roll->along);
        for (int k = 0; k < N * nx; k++)
            e[k] = failed ? (double)NAN : X[nx + k] - x_ref[nx + k];
    }
    for (int k = 0; k < at->nodes.size; k++)
        for (int l = 0; l < at->d; l++)
            roll->p[k * at->d + l] -= x0[core->p.position[l]];
    core->scratch.used = used;
    return failed;
}

int tracking(scp_core *core, const double *X, const double *U, double *inputs, double *e)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used, states = (size_t)(N * nx);
    double *A = doubles(&core->scratch, states * (size_t)nx);
    double *B = doubles(&core->scratch, states * (size_t)nu);
    double *drift = doubles(&core->scratch, states), *away = doubles(&core->scratch, (size_t)nx);
    double *du = doubles(&core->scratch, (size_t)(N * nu));
    int failed = model_linearise(core, N, X, U, 1.0, drift, A, B);
    if (!failed) {
        for (int k = 0; k < N * nx; k++)
            drift[k] -= X[nx + k];
        for (int k = 0; k < nx; k++)
            away[k] = core->now->x0[k] - X[k];
        add_product(nx, nx, A, away, drift);
        failed = regulate(core, A, B, drift, du);
    }
    for (int k = 0; k < N * nu && !failed; k++)
        inputs[k] = U[k] + du[k];
    for (int k = 0; k < N * nx && !failed; k++)
        e[k] = X[nx + k] + drift[k] - core->now->x_ref[nx + k];
    core->scratch.used = used;
    return failed;
}

/* Where a plan is, backwards: T times the gradient in its inputs, of what a later optimum leaves.
 * Returns the cost of deviations and inputs. */
static double place(scp_core *core, const rollout *roll, const sensitivity *by, double *here)
{
    const scp_problem *p = &core->p;
    int nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used;
    arena *room = &core->scratch;
    double *force = doubles(room, (size_t)nx), *next = doubles(room, (size_t)nx);
    double *push = doubles(room, (size_t)nu), *effort = doubles(room, (size_t)nu);
    double cost = 0;
    memset(next, 0, (size_t)nx * sizeof(double));
    for (int i = core->at.N - 1; i >= 0; i--) {
        const double *e = roll->e + i * nx, *B = roll->along.B + i * nx * nu;
        memset(force, 0, (size_t)nx * sizeof(double));
        add_product_t(nx, nx, i == core->at.N - 1 ? p->Qf : p->Q, e, force);
        for (int k = 0; k < nx; k++) {
            cost += force[k] * e[k];
            force[k] = 2 * force[k] + next[k];
        }
        for (int k = 0; k < nu; k++)
            push[k] = roll->u[i * nu + k] - p->rest[k], effort[k] = 0;
        add_product_t(nu, nu, p->R, push, effort);
        for (int k = 0; k < nu; k++) {
            cost += effort[k] * push[k];
            effort[k] *= 2; /* now the gradient in u */
            for (int c = 0; c < nx; c++)
                effort[k] += B[c * nu + k] * force[c];
        }
        for (int k = 0; k < nu; k++) {
            double sum = 0;
            for (int c = 0; c <= k; c++)
                sum += by->T[(i * nu + k) * nu + c] * effort[c];
            here[i * nu + k] = sum;
        }
        memset(next, 0, (size_t)nx * sizeof(double));
        add_product_t(nx, nx, roll->along.A + i * nx * nx, force, next);
        for (int k = 0; k < nu; k++)
            axpy(nx, -effort[k], by->K + (i * nu + k) * nx, next);
    }
    core->scratch.used = used;
    return cost;
}

int condense(scp_core *core, const rollout *roll, const double *s, sensitivity *room, condensed *c)
{
    const layout *at = &core->at;
    if (!core->linear && sensitivity_along(core, &roll->along, room))
        return 1;
    size_t used = core->scratch.used;
    double *de = doubles(&core->scratch, (size_t)(at->N * at->nx));
    double *du = doubles(&core->scratch, (size_t)at->n);
    double *dp = doubles(&core->scratch, (size_t)(at->nodes.size * at->d));
    double *free_s = doubles(&core->scratch, (size_t)at->M);
    c->about = roll;
    c->by = core->linear ? &core->always_by : room;
    double cost = place(core, roll, c->by, c->here);
    for (int j = 0; j < at->M; j++) {
        double away = s[j] - core->p.s_ref;
        cost += core->p.s_weight * away * away;
        free_s[j] = at->moving ? core->p.s_ref : s[j];
        if (at->moving)
            c->here[at->n + j] = sqrt(2 * core->p.s_weight) * away;
    }
    c->least = cost - dot(at->nv, c->here, c->here) / 2;
    respond(core, &roll->along, c->by, c->here, -1, de, du);
    derivatives_positions(core, &roll->along, de, du, dp);
    axpy(at->N * at->nx, 1, roll->e, de);
    axpy(at->n, 1, roll->u, du);
    axpy(at->nodes.size * at->d, 1, roll->p, dp);
    outputs_of(core, dp, free_s, du, de, c->y_free);
    core->scratch.used = used;
    return 0;
}

void y_of(const scp_core *core, const condensed *c, const double *v, double *y)
{
    const layout *at = &core->at;
    arena *room = &((scp_core *)core)->scratch;
    size_t used = room->used;
    double *de = doubles(room, (size_t)(at->N * at->nx)), *du = doubles(room, (size_t)at->n);
    double *dp = doubles(room, (size_t)(at->nodes.size * at->d));
    double *ds = doubles(room, (size_t)at->M);
    respond(core, &c->about->along, c->by, v, 1, de, du);
    derivatives_positions(core, &c->about->along, de, du, dp);
    for (int j = 0; j < at->M; j++)
        ds[j] = at->moving ? v[at->n + j] / sqrt(2 * core->p.s_weight) : 0;
    write_outputs(core, dp, ds, du, NULL, de, y);
    axpy(at->ny, 1, c->y_free, y);
    room->used = used;
}

void deviations_of(const scp_core *core, const condensed *c, const double *v, double *e)
{
    const layout *at = &core->at;
    arena *room = &((scp_core *)core)->scratch;
    size_t used = room->used;
    double *du = doubles(room, (size_t)at->n), *step_v = doubles(room, (size_t)at->n);
    for (int k = 0; k < at->n; k++)
        step_v[k] = v[k] - c->here[k];
    respond(core, &c->about->along, c->by, step_v, 1, e, du);
    axpy(at->N * at->nx, 1, c->about->e, e);
    room->used = used;
}

/* All that may be taken at once: `tracking`, or `condense` above `place`, or `roll_out`. */
size_t scratch_of_condensing(const scp_core *core)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu, states = at->N * nx, takes = 10;
    int back = states * (nx + nu + 1) + nx + at->n;
    int plan = 2 * states + at->nodes.size * at->d + at->n + at->M + 3 * nx + 2 * nu;
    return ((size_t)(back > plan ? back : plan) + 8 * (size_t)takes) * sizeof(double);
}
