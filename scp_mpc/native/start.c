/* Where a nonlinear robot's search begins: the best of simple manoeuvres;
 * scp_mpc/scp/manoeuvres.py.
 *
 * A local search ends in the next stationary point, and standing often is one: to first order it
 * brings nothing to turn towards a goal behind. So some plans are tried that hold one corner of the
 * inputs' bounds for a part of the horizon and another one after it.
 *
 * Notation:
 *     W   manoeuvres: shares of the horizon, times second corners, times first ones
 */
#include "core.h"

static const double SHARES[] = {0.25, 0.5, 0.75}; /* of the horizon, before the second input */
enum {
    SHARE_COUNT = 3,
    MOST_COMBINED = 2, /* inputs, above which only one at a time is off its rest */
    LEVELS = 3         /* of an input: at rest, at its lower bound, at its upper one */
};

static int corner_count(int nu)
{
    int count = 1;
    for (int i = 0; i < nu && nu <= MOST_COMBINED; i++)
        count *= LEVELS;
    return nu <= MOST_COMBINED ? count : 1 + (LEVELS - 1) * nu;
}

size_t scratch_of_start(const scp_core *core)
{
    size_t corners = (size_t)corner_count(core->at.nu), W = SHARE_COUNT * corners * corners;
    size_t nx = (size_t)core->at.nx, nu = (size_t)core->at.nu;
    size_t reals = W * (2 * nx + nu + 1) + nx + (LEVELS + 1) * nu;
    return reals * sizeof(double) + W * (size_t)core->at.n + 10 * 64;
}

/* Which level input i has in a corner. */
static int level_in(int nu, int corner, int i)
{
    if (nu > MOST_COMBINED)
        return corner > 0 && (corner - 1) % nu == i ? 1 + (corner - 1) / nu : 0;
    for (int k = nu - 1; k > i; k--)
        corner /= LEVELS;
    return corner % LEVELS;
}

/* Levels (W, N, nu). */
static void lay_plans(const scp_core *core, int corners, uint8_t *level)
{
    int N = core->at.N, nu = core->at.nu, w = 0;
    for (int share = 0; share < SHARE_COUNT; share++) {
        double change = nearbyint(SHARES[share] * N);
        for (int pair = 0; pair < corners * corners; pair++, w++)
            for (int k = 0; k < N; k++)
                for (int i = 0; i < nu; i++) {
                    int corner = k >= change ? pair / corners : pair % corners;
                    level[(w * N + k) * nu + i] = (uint8_t)level_in(nu, corner, i);
                }
    }
}

/* By how much a state is outside its bounds, added up. */
static double outside(const scp_core *core, const double *x)
{
    const scp_problem *p = &core->p;
    double sum = 0.0;
    for (int b = 0; b < p->rows; b++) {
        double value = dot(p->nx, p->row + b * p->nx, x);
        double beyond = fmax(p->row_min[b] - value, value - p->row_max[b]);
        sum += beyond <= 0.0 ? 0.0 : beyond; /* or NaN */
    }
    return sum;
}

/* Where an input leads outside of the bounds, parts of it rest if that leads less far. */
static void rest_outside(const scp_core *core, const double *x, const double *rest, uint8_t *level,
                         double *u, double *after, double *tried)
{
    double excess = core->at.nb ? outside(core, after) : 0.0;
    for (int i = 0; i < core->at.nu && excess > 0; i++) {
        double held = u[i];
        u[i] = rest[i];
        int failed = model_step(core, x, u, tried);
        double less = failed ? NAN : outside(core, tried);
        if (less < excess) {
            excess = less;
            level[i] = 0;
            memcpy(after, tried, (size_t)core->at.nx * sizeof *after);
        } else {
            u[i] = held;
        }
    }
}

static double weighed(int n, const double *W, const double *a, const double *b)
{
    double sum = 0.0;
    for (int i = 0; i < n; i++) {
        double row = 0.0;
        for (int j = 0; j < n; j++)
            row += W[i * n + j] * (a[j] - b[j]);
        sum += (a[i] - b[i]) * row;
    }
    return sum;
}

/* What manoeuvres cost (W,), whose levels are changed where they would leave the bounds. */
static void drive(scp_core *core, int W, const double *values, uint8_t *level, double *cost)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    int nx = at->nx, nu = at->nu;
    double *x = doubles(&core->scratch, (size_t)(W * nx));
    double *after = doubles(&core->scratch, (size_t)(W * nx));
    double *u = doubles(&core->scratch, (size_t)(W * nu));
    double *tried = doubles(&core->scratch, (size_t)nx);
    for (int w = 0; w < W; w++) {
        memcpy(x + w * nx, core->now->x0, (size_t)nx * sizeof *x);
        cost[w] = 0.0;
    }
    for (int k = 0; k < at->N; k++) {
        for (int w = 0; w < W; w++)
            for (int i = 0; i < nu; i++)
                u[w * nu + i] = values[level[(w * at->N + k) * nu + i] * nu + i];
        if (model_advance(core, W, x, u, 1.0, after)) {
            for (int w = 0; w < W; w++)
                cost[w] = INFINITY;
            return;
        }
        const double *wanted = core->now->x_ref + (k + 1) * nx, *Q = k + 1 < at->N ? p->Q : p->Qf;
        for (int w = 0; w < W; w++) {
            rest_outside(core, x + w * nx, values, level + (w * at->N + k) * nu, u + w * nu,
                         after + w * nx, tried);
            cost[w] += weighed(nx, Q, after + w * nx, wanted);
            cost[w] += weighed(nu, p->R, u + w * nu, p->rest);
        }
        memcpy(x, after, (size_t)(W * nx) * sizeof *x);
    }
}

/* The cheapest one that begins with none of the `count` beginnings already there; -1 for none. */
static int next_best(const scp_core *core, int W, const double *cost, const double *values,
                     const uint8_t *level, int count, const double *U)
{
    int n = core->at.n, nu = core->at.nu, best = -1;
    for (int w = 0; w < W; w++) {
        int known = 0;
        for (int c = 0; c < count && !known; c++) {
            known = 1;
            for (int i = 0; i < nu; i++)
                known &= !(U[c * n + i] < values[level[w * n + i] * nu + i]) &&
                         !(U[c * n + i] > values[level[w * n + i] * nu + i]);
        }
        if (!known && (best < 0 || cost[w] < cost[best]))
            best = w;
    }
    return best;
}

/* Inputs (most, N, nu) of those that cost least, no two of which begin alike; returns how many. */
int manoeuvres(scp_core *core, int most, double *U)
{
    int n = core->at.n, nu = core->at.nu, count = 0;
    int corners = corner_count(nu), W = SHARE_COUNT * corners * corners;
    size_t mark = core->scratch.used;
    double *values = doubles(&core->scratch, (size_t)(LEVELS * nu));
    double *cost = doubles(&core->scratch, (size_t)W);
    uint8_t *level = bytes(&core->scratch, (size_t)(W * n));
    resting_input(core, values);
    for (int i = 0; i < nu; i++) {
        values[nu + i] = core->p.u_min[i];
        values[2 * nu + i] = core->p.u_max[i];
    }
    lay_plans(core, corners, level);
    drive(core, W, values, level, cost);
    for (int w = 0; w < W; w++)
        cost[w] = isfinite(cost[w]) ? cost[w] : INFINITY;
    while (count < most) {
        int best = next_best(core, W, cost, values, level, count, U);
        if (best < 0)
            break;
        for (int i = 0; i < n; i++)
            U[count * n + i] = values[level[best * n + i] * nu + i % nu];
        count++;
    }
    core->scratch.used = mark;
    return count;
}
