/* Braking: to rest, as hard as the bounds of the inputs allow, in the direction of motion;
 * scp_mpc/scp/braking.py. And what bounds and weights say of a plan: scp_mpc/problem.py. */
#include "core.h"
#include "small.h"

static const double NO_INPUT = 1e-9; /* of an input, in its own unit */
static const double ROUNDING = 1e-9; /* of an input, by which a rate may exceed its bounds */

/* What is no number stays: it has to be seen. */
static double clip(double x, double low, double high)
{
    x = x < low ? low : x;
    return x > high ? high : x;
}

static double most_of(double x, double most) { return x > most || isnan(x) ? x : most; }

/* ---- inputs */

static double resting(const scp_core *core, int l)
{
    return clip(core->p.rest[l], core->p.u_min[l], core->p.u_max[l]);
}

void resting_input(const scp_core *core, double *u)
{
    for (int l = 0; l < core->at.nu; l++)
        u[l] = resting(core, l);
}

/* Where an input was so far outside its bounds that no rate leads back, its rate gives way: the
 * bound itself is the one value allowed. */
static double lowest(const scp_problem *p, int l, double last)
{
    return lesser(last + p->du_min[l], p->u_max[l]);
}

static double highest(const scp_problem *p, int l, double last)
{
    return larger(last + p->du_max[l], p->u_min[l]);
}

void reach(const scp_core *core, const double *u_last, double *lower, double *upper)
{
    const int bounded = u_last && core->p.limits_rates;
    for (int l = 0; l < core->at.nu; l++) {
        lower[l] = bounded ? lowest(&core->p, l, u_last[l]) : -INFINITY;
        upper[l] = bounded ? highest(&core->p, l, u_last[l]) : INFINITY;
    }
}

static int change_too_fast(const scp_core *core, int N, const double *U)
{
    const scp_problem *p = &core->p;
    const int nu = core->at.nu;
    for (int k = nu; k < N * nu; k++) {
        double change = U[k] - U[k - nu];
        if (change > p->du_max[k % nu] + ROUNDING || change < p->du_min[k % nu] - ROUNDING)
            return 1;
    }
    return 0;
}

/* Inputs (N, nu), the first after u_last, moved into all their bounds, one after the other, each as
 * little as the one before allows; those whose later changes exceed their bounds by rounding alone
 * are kept. */
void limited(const scp_core *core, int N, double *U, const double *u_last)
{
    const scp_problem *p = &core->p;
    const int nu = core->at.nu;
    for (int k = 0; k < N * nu; k++)
        U[k] = clip(U[k], p->u_min[k % nu], p->u_max[k % nu]);
    if (!p->limits_rates)
        return;
    for (int l = 0; u_last && l < nu; l++) {
        double reached = clip(U[l], lowest(p, l, u_last[l]), highest(p, l, u_last[l]));
        U[l] = clip(reached, p->u_min[l], p->u_max[l]);
    }
    if (!change_too_fast(core, N, U))
        return;
    for (int k = nu; k < N * nu; k++) {
        int l = k % nu;
        double reached = clip(U[k], U[k - nu] + p->du_min[l], U[k - nu] + p->du_max[l]);
        U[k] = clip(reached, p->u_min[l], p->u_max[l]);
    }
}

/* ---- braking */

/* The input (nu,) that stops the robot, as far as the bounds allow; 0 and that of rest if it is at
 * rest, or its state is no number. */
static int stop(const scp_core *core, const double *x, double *u)
{
    const scp_problem *p = &core->p;
    const int nu = core->at.nu;
    double most = 0, share = 1;
    model_stopping_input(core, x, u);
    for (int l = 0; l < nu; l++)
        most = most_of(fabs(u[l] - resting(core, l)), most);
    int moves = most > NO_INPUT;
    for (int l = 0; moves && l < nu; l++) {
        /* In the direction of what is wanted; inputs without any room stay where they are. */
        double rest = resting(core, l), wanted = u[l] - rest;
        double room = (wanted > 0 ? p->u_max[l] : p->u_min[l]) - rest;
        if (fabs(room) > NO_INPUT)
            share = larger(wanted / room, share);
        else
            u[l] = rest;
    }
    for (int l = 0; l < nu; l++) {
        double rest = resting(core, l);
        u[l] = moves ? rest + (u[l] - rest) / share : rest;
    }
    return moves;
}

static int rests(const scp_core *core, const double *u)
{
    for (int l = 0; l < core->at.nu; l++)
        if (u[l] != resting(core, l))
            return 0;
    return 1;
}

int braking(const scp_core *core, int N, const double *x, const double *u_last, double *U, double *X)
{
    const int nx = core->at.nx, nu = core->at.nu;
    memmove(X, x, (size_t)nx * sizeof *X);
    for (int k = 0; k < N; k++, U += nu, X += nx) {
        int moves = stop(core, X, U);
        limited(core, 1, U, u_last);
        if (!moves && rests(core, U))
            return k;
        if (model_step(core, X, U, X + nx))
            for (int l = 0; l < nx; l++)
                X[nx + l] = (double)NAN;
        u_last = U;
    }
    return N;
}

void brake_now(scp_core *core)
{
    if (core->braking_steps < 0)
        core->braking_steps = braking(core, core->at.N, core->plain.x0, core->plain.u_last,
                                      core->braking_u, core->braking_x);
}

/* ---- plans */

/* Whether a plan hardly moves, and not because it is where its reference is. */
int stands(const scp_core *core, const double *X)
{
    const int nx = core->at.nx;
    double away = 0, wanted = 0, still = AT_REST * core->p.dt * core->at.N;
    for (int i = 1; i <= core->at.N; i++)
        for (int l = 0; l < core->at.d; l++) {
            int at = core->p.position[l];
            away = most_of(fabs(X[i * nx + at] - X[at]), away);
            wanted = most_of(fabs(core->x_ref[i * nx + at] - X[at]), wanted);
        }
    return away < still && still < wanted;
}

/* By how much a state is outside the bounds of a row. */
static double excess(const scp_core *core, int r, const double *x)
{
    double value = dot(core->at.nx, core->p.row + r * core->at.nx, x);
    return most_of(value - core->p.row_max[r], most_of(core->p.row_min[r] - value, 0.0));
}

double row_excess(const scp_core *core, int N, const double *X, int hard_only)
{
    double most = 0;
    for (int i = 1; i <= N; i++)
        for (int r = 0; r < core->at.nb; r++)
            if (!(hard_only && core->p.row_soft[r]))
                most = most_of(excess(core, r, X + i * core->at.nx), most);
    return most;
}

double plan_penalty(const scp_core *core, const double *slack, const double *X)
{
    double states = 0, obstacles = 0;
    for (int k = 0; k < core->at.most_pairs; k++)
        obstacles += slack[k];
    for (int i = 1; i <= core->at.N; i++)
        for (int r = 0; r < core->at.nb; r++)
            if (core->p.row_soft[r])
                states += excess(core, r, X + i * core->at.nx);
    return core->p.slack_weight * obstacles + core->p.state_slack_weight * states;
}

/* (a - b)'W (a - b) */
static double weighed(int n, const double *W, const double *a, const double *b)
{
    double sum = 0;
    for (int k = 0; k < n; k++) {
        double row = 0;
        for (int l = 0; l < n; l++)
            row += W[k * n + l] * (a[l] - b[l]);
        sum += row * (a[k] - b[k]);
    }
    return sum;
}

double plan_cost(const scp_core *core, const double *X, const double *U, const double *s)
{
    const scp_problem *p = &core->p;
    const int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    double cost = 0, sizes = 0;
    for (int i = 1; i <= N; i++)
        cost += weighed(nx, i < N ? p->Q : p->Qf, X + i * nx, core->x_ref + i * nx);
    for (int i = 0; i < N; i++)
        cost += weighed(nu, p->R, U + i * nu, p->rest);
    for (int j = 0; j < core->at.M; j++)
        sizes += (s[j] - p->s_ref) * (s[j] - p->s_ref);
    return cost + p->s_weight * sizes;
}
