/* The fallback hierarchy: what to do when the search has no plan that meets every constraint;
 * scp_mpc/scp/fallback.py.
 *
 * 1. the certified plan       2. a feasible iterate
 * 3. the last plan, shifted: its inputs from the state now, rechecked against the new predictions
 * 4. braking at the model's limits, checked likewise
 * 5. the plan with slack, or as much of it as leaves time to brake before it violates anything
 * 6. braking, whatever is in the way
 */
#include "core.h"
#include "small.h"

static const double STANDS = 0.3; /* [m/s] up to which an obstacle does, whose velocity is estimated */

/* A plan that needs no program, or what is asked of one that came from elsewhere. */
typedef struct {
    double *X, *U, *slack; /* (N+1, nx), (N, nu), (M, C) */
    double cost, merit, feasibility;
    scp_status status;
} trial;

static trial new_trial(scp_core *core)
{
    const layout *at = &core->at;
    return (trial){.X = doubles(&core->scratch, (size_t)((at->N + 1) * at->nx)),
                   .U = doubles(&core->scratch, (size_t)at->n),
                   .slack = doubles(&core->scratch, (size_t)at->most_pairs)};
}

size_t scratch_of_fallback(const scp_core *core)
{
    const layout *at = &core->at;
    int late = backup_horizon(core), count = at->nodes.count, M = at->M;
    size_t trials = 3 * (size_t)((at->N + 1) * at->nx + at->n + at->most_pairs);
    size_t one = (size_t)(late * (2 + count * (at->d + M)) + 2 * M);
    return (trials + one) * sizeof(double) + 2048;
}

/* ---- judging inputs */

/* States that inputs lead to. Where the model has no next state, it stays in the last one. */
static int roll(const scp_core *core, int N, const double *x0, const double *U, double *X)
{
    const int nx = core->at.nx, nu = core->at.nu;
    memmove(X, x0, (size_t)nx * sizeof *X);
    for (int i = 0; i < N; i++) {
        const double *before = X + i * nx;
        double *after = X + (i + 1) * nx;
        int lost = model_step(core, before, U + i * nu, after);
        for (int l = 0; l < nx; l++)
            lost |= !isfinite(after[l]);
        for (int k = i + 1; lost && k <= N; k++)
            memcpy(X + k * nx, before, (size_t)nx * sizeof *X);
        if (lost)
            return 1;
    }
    return 0;
}

int depths_of(scp_core *core, const step *at, const double *U, double *X, double *deep)
{
    const nodes of = at->nodes;
    const size_t mark = core->scratch.used;
    int lost = roll(core, of.N, at->x0, U, X);
    double *path = doubles(&core->scratch, (size_t)(of.size * core->at.d));
    double *s = doubles(&core->scratch, (size_t)core->at.M);
    step wide = *at;
    for (int j = 0; j < at->J; j++)
        s[j] = core->p.s_min; /* all that a plan without a search can promise */
    if (at->J && of.K > 1) { /* between the nodes it is judged by its own motion */
        motion m = {doubles(&core->scratch, (size_t)of.N), doubles(&core->scratch, (size_t)of.N)};
        wide.radii = doubles(&core->scratch, (size_t)(at->J * of.size));
        nodes_motion(core, of, X, U, &m);
        nodes_radii(of, at->J, at->radii, at->drift, &m, wide.radii);
    }
    if (at->J) {
        nodes_positions(core, of, X, U, path);
        depths(core, &wide, path, s, deep);
    }
    core->scratch.used = mark;
    return lost;
}

/* Inputs that are there, with their true violation: FALLBACK where there is any. */
static void judge(scp_core *core, const step *at, scp_status status, trial *t)
{
    const int M = core->at.M, all = core->at.most_pairs;
    const size_t mark = core->scratch.used;
    double *s = doubles(&core->scratch, (size_t)M);
    for (int k = 0; k < all; k++)
        t->slack[k] = 0;
    int lost = depths_of(core, at, t->U, t->X, t->slack);
    double most = row_excess(core, core->at.N, t->X, 0);
    for (int k = 0; k < all; k++)
        most = t->slack[k] > most || isnan(t->slack[k]) ? t->slack[k] : most;
    for (int j = 0; j < M; j++)
        s[j] = j < at->J ? core->p.s_min : core->p.s_ref;
    t->feasibility = lost ? INFINITY : most;
    t->status = is_ok(status) && !(t->feasibility <= core->p.tolerance) ? SCP_FALLBACK : status;
    t->cost = plan_cost(core, t->X, t->U, s);
    t->merit = t->cost + plan_penalty(core, t->slack, t->X);
    core->scratch.used = mark;
}

static void hand_out(const scp_core *core, const step *at, const trial *t, result *to)
{
    const layout *c = &core->at;
    memcpy(to->it.states, t->X, (size_t)((c->N + 1) * c->nx) * sizeof(double));
    memcpy(to->it.inputs, t->U, (size_t)c->n * sizeof(double));
    memcpy(to->it.slack, t->slack, (size_t)c->most_pairs * sizeof(double));
    for (int j = 0; j < c->M; j++)
        to->it.s[j] = j < at->J ? core->p.s_min : core->p.s_ref;
    to->it.has_multipliers = 0;
    to->cost = t->cost;
    to->merit = t->merit;
    to->kkt = (residuals){INFINITY, t->feasibility, INFINITY, (double)NAN};
    to->status = t->status;
    to->iterations = 0;
    to->there = 1;
    to->has_nominal = 0;
}

/* A plan's first inputs, if any, then braking (steps, nu), then rest. */
static void fill(const scp_core *core, int first, const double *stop, int steps, double *U)
{
    const int nu = core->at.nu, N = core->at.N;
    int end = first + steps < N ? first + steps : N;
    if (stop && end > first)
        memmove(U + first * nu, stop, (size_t)((end - first) * nu) * sizeof *U);
    for (int i = end; i < N; i++)
        resting_input(core, U + i * nu);
}

/* Roll the last plan's inputs out from the state now. */
static trial keep(scp_core *core, const step *at, const double *U, scp_status status)
{
    trial t = new_trial(core);
    memcpy(t.U, U, (size_t)core->at.n * sizeof *U);
    limited(core, core->at.N, t.U, at->u_last);
    judge(core, at, status, &t);
    return t;
}

/* Bring the robot to rest, as hard as the bounds allow, in the direction it moves. */
static trial brake(scp_core *core, const step *at, scp_status status)
{
    trial t = new_trial(core);
    brake_now(core);
    fill(core, 0, core->braking_u, core->braking_steps, t.U);
    limited(core, core->at.N, t.U, at->u_last);
    judge(core, at, status, &t);
    return t;
}

void judge_inputs(scp_core *core, const step *at, const double *U, scp_status status, result *to)
{
    const size_t mark = core->scratch.used;
    trial t = keep(core, at, U, status);
    hand_out(core, at, &t, to);
    core->scratch.used = mark;
}

void judge_braking(scp_core *core, const step *at, scp_status status, result *to)
{
    const size_t mark = core->scratch.used;
    trial t = brake(core, at, status);
    hand_out(core, at, &t, to);
    core->scratch.used = mark;
}

/* ---- passive safety */

/* How deep a plan enters a no-go set in interval i. */
static double deepest(const step *at, const trial *t, int j, int i)
{
    const double *slack = t->slack + j * at->nodes.size + i * at->nodes.count;
    double most = 0;
    for (int k = 0; k < at->nodes.count; k++)
        most = slack[k] > most || isnan(slack[k]) ? slack[k] : most;
    return most;
}

/* How far the robot goes in interval i. */
static double way(const scp_core *core, const trial *t, int i)
{
    const double *x = t->X + i * core->at.nx, *after = x + core->at.nx;
    double sum = 0;
    for (int l = 0; l < core->at.d; l++) {
        int at = core->p.position[l];
        sum += (after[at] - x[at]) * (after[at] - x[at]);
    }
    return sqrt(sum);
}

/* Whether an obstacle hardly moves. */
static int is_standing(const scp_core *core, const step *at, int j)
{
    const int d = core->at.d, C = at->nodes.size, apart = at->nodes.count * d;
    const double *mean = at->means + j * (C + 1) * d;
    for (int i = 0; i < at->nodes.N; i++, mean += apart) {
        double move[3] = {0};
        difference(d, mean + apart, mean, move);
        if (!(sqrt(inner(d, move, move)) <= STANDS * core->p.dt))
            return 0;
    }
    return 1;
}

/* Whether a plan is as slow as braking where it violates anything, or leaves it: whoever is in the
 * way then finds the robot at rest, or as slow as can be (passive motion safety: Macek, Vasquez,
 * Fraichard and Siegwart, 2009). What stands and is entered already may be left. */
static int is_passive(const scp_core *core, const step *at, const trial *plan, const trial *stop)
{
    const int N = core->at.N;
    const double tolerance = core->p.tolerance;
    double allowed = row_excess(core, N, stop->X, 1) + tolerance;
    if (plan->feasibility == INFINITY || row_excess(core, N, plan->X, 1) > allowed)
        return 0;
    for (int j = 0; j < at->J; j++) {
        int standing = is_standing(core, at, j);
        double before = INFINITY;
        for (int i = 0; i < N; i++) {
            double deep = deepest(at, plan, j, i);
            int leaves = standing && deep <= deepest(at, stop, j, i) + tolerance &&
                         deep <= before + tolerance;
            int slow = way(core, plan, i) <= way(core, stop, i) + AT_REST * core->p.dt;
            if (!(deep <= tolerance || slow || leaves))
                return 0;
            before = deep;
        }
    }
    return 1;
}

/* Whether braking has come to rest where it violates anything. */
static int rests_in_time(const scp_core *core, const step *at, const trial *stop)
{
    for (int j = 0; j < at->J; j++)
        for (int i = 0; i < core->at.N; i++)
            if (deepest(at, stop, j, i) > core->p.tolerance &&
                !(way(core, stop, i) <= AT_REST * core->p.dt))
                return 0;
    return 1;
}

/* The longest head of one of the plans, in their order, after which braking is passively safe. */
static int safe_head(scp_core *core, const step *at, const trial *const *plans, int count,
                     const trial *stop, trial *t)
{
    const int nx = core->at.nx, nu = core->at.nu, N = core->at.N;
    for (int head = N / 2; head >= 1; head /= 2)
        for (int k = 0; k < count; k++) {
            memcpy(t->U, plans[k]->U, (size_t)(head * nu) * sizeof *t->U);
            int steps = braking(core, N - head, plans[k]->X + head * nx, t->U + (head - 1) * nu,
                                t->U + head * nu, t->X);
            fill(core, head, NULL, steps, t->U);
            judge(core, at, SCP_STOPPING, t);
            if (is_passive(core, at, t, stop))
                return 1;
        }
    return 0;
}

/* The first plan, or the longest head of one followed by braking, that is passively safe. Braking
 * alone always is; whether it comes to rest in time is what its status says. */
static void stopping(scp_core *core, const step *at, trial *stop, const result *found,
                     const trial *kept, result *to)
{
    const trial *plans[2];
    int count = 0;
    trial of_search = {0}, t = new_trial(core);
    if (found) {
        of_search = (trial){found->it.states, found->it.inputs, found->it.slack, found->cost,
                            found->merit, found->kkt.feasibility, found->status};
        plans[count++] = &of_search;
    }
    if (kept)
        plans[count++] = kept;
    for (int k = 0; k < count; k++) {
        if (!is_passive(core, at, plans[k], stop))
            continue;
        if (plans[k] == kept)
            hand_out(core, at, kept, to);
        else if (found != to)
            copy_result(core, found, to);
        if (!is_certified(plans[k]->status))
            to->status = SCP_STOPPING;
        return;
    }
    if (safe_head(core, at, plans, count, stop, &t)) {
        hand_out(core, at, &t, to);
        return;
    }
    if (rests_in_time(core, at, stop))
        stop->status = SCP_STOPPING;
    hand_out(core, at, stop, to);
}

/* The last plan or braking, if it meets every constraint; else what is passively safe. `last` is
 * the last plan, shifted, `found` what a search ended with that does not meet every constraint; both
 * may be NULL, and `found` may be where the result goes. */
void fall_back(scp_core *core, const step *at, const scp_iterate *last, const result *found,
               int brake_first, result *to)
{
    const size_t mark = core->scratch.used;
    trial stop = {0}, kept = {0};
    const trial *best = NULL;
    if (brake_first || !last) {
        stop = brake(core, at, SCP_BRAKING);
        best = is_ok(stop.status) ? &stop : NULL;
    }
    if (!best && last) {
        kept = keep(core, at, last->inputs, SCP_PREVIOUS);
        best = is_ok(kept.status) ? &kept : NULL;
    }
    if (!best && !stop.X) {
        stop = brake(core, at, SCP_BRAKING);
        best = is_ok(stop.status) ? &stop : NULL;
    }
    if (best)
        hand_out(core, at, best, to);
    else
        stopping(core, at, &stop, found, last ? &kept : NULL, to);
    core->scratch.used = mark;
}
