/* One control step in numbers: what the loop reads, writes, has solved and certified.
 * scp_mpc/scp/transcription.py, iterate.py, and what is needed of qp/backend.py.
 *
 * A program is solved from the active set of the plan about which it was made: the constraints that
 * push it. Where that does not lead to the solution, none is active at first.
 */
#include "core.h"

enum {
    REPAIRS = 10,      /* of the bounds of a plan that ignores the obstacles */
    CHANGES = 100,     /* of the active set of a plan, before it is forgotten */
    MOST_CHANGES = 4000 /* where inputs saturate and obstacles yield, it is a simplex method */
};
static const double MOVED = 1e-6;     /* of a state: the robot is not where the guess has it */
static const double ROUNDING = 1e-10; /* of a bounded entry, in its own unit */
static const double NEAR = 2.0;       /* [m] beyond the no-go set; pairs farther off stay out */
static const double NEGLIGIBLE = 1e-6; /* force that is none: iterate.py */
static const double AT_WEIGHT = 1e-9; /* relative distance of a force to its l1 weight */

void lay_out_transcription(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    workspace *kept = take(from, 1, sizeof *kept), w;
    memset(&w, 0, sizeof w);
    lay_out_program(core, from, &w.program);
    if (!core->linear)
        lay_out_sensitivity(core, from, &w.by);
    lay_out_solution(core, from, &w.convex);
    w.nobody = bytes(from, (size_t)at->most_pairs);
    w.full = doubles(from, (size_t)at->M);
    core->work = kept;
    if (kept != NULL)
        *kept = w;
}

void set_up_transcription(scp_core *core)
{
    memset(core->work->nobody, 0, (size_t)core->at.most_pairs);
    for (int j = 0; j < core->at.M; j++)
        core->work->full[j] = core->p.s_ref;
}

void begin_transcription(scp_core *core)
{
    scp_outputs *out = &core->out;
    core->broken = 0;
    out->kkt = out->solved = out->ranked = out->cut = out->infeasible = 0;
    out->has_obstacle_free = 0;
}

size_t scratch_of_transcription(const scp_core *core)
{
    const layout *at = &core->at;
    size_t plan = (size_t)((at->N + 1) * at->nx + at->n + at->M + at->nodes.size * at->d + at->d);
    size_t reals = 2 * plan + (size_t)(2 * at->ny + 2 * at->most_pairs + at->N * at->nx);
    return reals * sizeof(double) + (size_t)(3 * at->most_pairs + at->nf) + 32 * 64;
}

/* ---- pairs */

void make_pairs(const scp_core *core, const uint8_t *near, pairs *to)
{
    int J = core->now->J, C = core->at.nodes.size;
    to->count = 0;
    for (int j = 0; j < J; j++)
        for (int i = 0; i < C; i++)
            if (near[j * C + i]) {
                to->obstacle[to->count] = j;
                to->node[to->count++] = i;
            }
    if (to->near != near)
        memcpy(to->near, near, (size_t)(J * C));
}

static void copy_pairs(const scp_core *core, const pairs *from, pairs *to)
{
    size_t count = (size_t)from->count;
    if (from == to)
        return;
    to->count = from->count;
    memcpy(to->obstacle, from->obstacle, count * sizeof(int));
    memcpy(to->node, from->node, count * sizeof(int));
    memcpy(to->near, from->near, (size_t)(core->now->J * core->at.nodes.size));
}

/* Pairs in `known` or near to a plan; if there is none, all. They may be the same array. */
void near_pairs(scp_core *core, const double *y, const uint8_t *known, uint8_t *near)
{
    const layout *at = &core->at;
    int count = core->now->J * at->nodes.size, any = 0;
    size_t mark = core->scratch.used;
    double *path = doubles(&core->scratch, (size_t)((at->nodes.size + 1) * at->d));
    uint8_t *more = bytes(&core->scratch, (size_t)at->most_pairs);
    path_of(core, y, path);
    if (!within(core, core->now, path, y + at->s, NEAR, known, more))
        memset(more, 0, (size_t)count);
    for (int k = 0; k < count; k++)
        any |= near[k] = known[k] || more[k];
    if (!any)
        memset(near, 1, (size_t)count);
    core->scratch.used = mark;
}

/* The pairs that a program should have held; 0 if its plan violates none without. A plan without
 * any pairs ignores the obstacles on purpose. */
int screen(scp_core *core, const nominal *plan, uint8_t *near)
{
    const layout *at = &core->at;
    int count = core->now->J * at->nodes.size, missed = 0;
    size_t mark = core->scratch.used;
    if (!plan->pairs.count)
        return 0;
    double *path = doubles(&core->scratch, (size_t)((at->nodes.size + 1) * at->d));
    path_of(core, plan->y, path);
    missed = within(core, core->now, path, plan->y + at->s, 0.0, plan->pairs.near, near);
    if (missed) {
        for (int k = 0; k < count; k++)
            near[k] |= plan->pairs.near[k];
        near_pairs(core, plan->y, near, near);
    }
    core->scratch.used = mark;
    return missed;
}

/* ---- plans */

static void fill(int n, double value, double *a)
{
    for (int i = 0; i < n; i++)
        a[i] = value;
}

/* The residuals of a plan whose y, roll, reaction, pairs and force are there. Who yields has a
 * slack that is not zero; NULL for nobody. */
void judge_plan(scp_core *core, nominal *n, const uint8_t *yields, relaxation level)
{
    find_planes(core, core->now, &n->pairs, n->y, &n->planes);
    for (int k = 0; k < n->pairs.count; k++)
        n->slack[k] = yields != NULL && yields[k] && n->planes.g[k] < 0 ? -n->planes.g[k] : 0.0;
    certify(core, n, level);
}

/* Clip inputs (N, nu) and sizes (M,) to their bounds and roll out: y and roll of a plan. */
int rolled(scp_core *core, const double *U, const double *s, const double *guess_e, nominal *to)
{
    const layout *at = &core->at;
    size_t mark = core->scratch.used;
    double *u = doubles(&core->scratch, (size_t)at->n);
    double *sizes = doubles(&core->scratch, (size_t)at->M);
    memcpy(u, U, (size_t)at->n * sizeof *u);
    limited(core, at->N, u, core->now->u_last);
    for (int j = 0; j < at->M; j++)
        sizes[j] = at->moving ? fmin(fmax(s[j], core->p.s_min), core->p.s_max) : s[j];
    int failed = roll_out(core, u, guess_e, &to->roll);
    outputs_of(core, to->roll.p, sizes, u, to->roll.e, to->y);
    core->scratch.used = mark;
    return failed;
}

/* Where a plan cannot be rolled out, there is nothing to go on with. */
static int broke(scp_core *core, nominal *to)
{
    to->cost = NAN;
    core->broken = 1;
    return 1;
}

int plain_nominal(scp_core *core, const double *U, const double *guess_e, nominal *to)
{
    if (rolled(core, U, core->work->full, guess_e, to))
        return broke(core, to);
    fill(core->at.nf, 0.0, to->reaction);
    make_pairs(core, core->work->nobody, &to->pairs);
    judge_plan(core, to, NULL, RELAX_NONE);
    return 0;
}

/* Where the loop may roll an iterate out from: its inputs and deviations, with feedback from a
 * state that a disturbance has moved. */
static int led_back(scp_core *core, const scp_iterate *it, double *U, double *e)
{
    const layout *at = &core->at;
    double moved = 0.0;
    for (int i = 0; i < at->nx; i++)
        moved = fmax(moved, fabs(core->now->x0[i] - it->states[i]));
    if (moved > MOVED && !core->linear)
        return tracking(core, it->states, it->inputs, U, e);
    memcpy(U, it->inputs, (size_t)at->n * sizeof *U);
    for (int i = 0; i < at->N * at->nx; i++)
        e[i] = it->states[at->nx + i] - core->now->x_ref[at->nx + i];
    return 0;
}

/* Forces (nf,) of the bounds. */
static void reaction_of(const scp_core *core, const scp_iterate *it, double *reaction)
{
    const layout *at = &core->at;
    for (int j = 0; j < at->moving; j++)
        reaction[j] = -it->margin[j];
    for (int i = 0; i < at->n; i++)
        reaction[at->inputs + i] = -it->input_bounds[i];
    for (int i = 0; i < at->rated; i++)
        reaction[at->rates + i] = -it->rates[i];
    for (int i = 0; i < at->N * at->nb; i++)
        reaction[at->states + i] = -it->state_bounds[i];
}

int nominal_at(scp_core *core, const scp_iterate *it, const uint8_t *near, const double *about_y,
               nominal *to)
{
    const layout *at = &core->at;
    int C = at->nodes.size, count = core->now->J * C;
    size_t mark = core->scratch.used;
    double *U = doubles(&core->scratch, (size_t)at->n);
    double *e = doubles(&core->scratch, (size_t)(at->N * at->nx));
    int failed = led_back(core, it, U, e) || rolled(core, U, it->s, e, to);
    core->scratch.used = mark;
    if (failed)
        return broke(core, to);
    uint8_t *known = bytes(&core->scratch, (size_t)at->most_pairs);
    if (near == NULL) {
        for (int k = 0; k < count; k++)
            known[k] = it->has_multipliers && it->obstacles[k] < -NEGLIGIBLE;
        near_pairs(core, to->y, known, known);
        if (about_y != NULL)
            near_pairs(core, about_y, known, known);
        near = known;
    }
    make_pairs(core, near, &to->pairs);
    fill(at->nf, 0.0, to->reaction);
    fill(to->pairs.count, 0.0, to->force);
    if (it->has_multipliers) {
        reaction_of(core, it, to->reaction);
        for (int k = 0; k < to->pairs.count; k++)
            to->force[k] = -it->obstacles[to->pairs.obstacle[k] * C + to->pairs.node[k]];
    }
    judge_plan(core, to, NULL, RELAX_NONE);
    core->scratch.used = mark;
    return 0;
}

/* The same plan with other pairs (J, C), which include those that push. */
void with_pairs(scp_core *core, const nominal *plan, const uint8_t *near, nominal *to)
{
    int C = core->at.nodes.size;
    size_t mark = core->scratch.used;
    double *force = doubles(&core->scratch, (size_t)core->at.most_pairs);
    uint8_t *yields = bytes(&core->scratch, (size_t)core->at.most_pairs);
    uint8_t *slack = bytes(&core->scratch, (size_t)core->at.most_pairs);
    memset(slack, 0, (size_t)(core->now->J * C));
    fill(core->now->J * C, 0.0, force);
    for (int k = 0; k < plan->pairs.count; k++) {
        int pair = plan->pairs.obstacle[k] * C + plan->pairs.node[k];
        force[pair] = plan->force[k];
        slack[pair] = plan->slack[k] > 0;
    }
    copy_nominal(core, plan, to);
    make_pairs(core, near, &to->pairs);
    for (int k = 0; k < to->pairs.count; k++) {
        int pair = to->pairs.obstacle[k] * C + to->pairs.node[k];
        to->force[k] = force[pair];
        yields[k] = slack[pair];
    }
    judge_plan(core, to, yields, RELAX_NONE);
    core->scratch.used = mark;
}

/* ---- who is relaxed */

int relaxed_bounds(scp_core *core, relaxation level, const double **lower, const double **upper)
{
    int braked = level != RELAX_NONE && core->at.nb > 0;
    if (braked)
        brake_bounds(core);
    *lower = braked ? core->braked_lower : core->strict_lower;
    *upper = braked ? core->braked_upper : core->strict_upper;
    return *lower != core->lower || *upper != core->upper;
}

static int states_yield(scp_core *core)
{
    const layout *at = &core->at;
    for (int i = 0; i < at->nb; i++)
        if (core->p.row_soft[i])
            return 1;
    const double *lower, *upper;
    size_t rows = (size_t)(at->ny - at->z) * sizeof(double);
    relaxed_bounds(core, RELAX_STATES, &lower, &upper);
    return memcmp(core->strict_lower + at->z, lower + at->z, rows) != 0 ||
           memcmp(core->strict_upper + at->z, upper + at->z, rows) != 0;
}

/* Let whoever is next give way; 0 if nobody is left: hard obstacles never do. */
int relaxes(scp_core *core, relaxation *level, int hard)
{
    if (*level == RELAX_NONE && states_yield(core)) {
        *level = RELAX_STATES;
        return 1;
    }
    if (*level == RELAX_ALL || hard)
        return 0;
    *level = RELAX_ALL;
    return 1;
}

/* Cost and the penalties on all slack [m] and on the states' excess. */
double merit_of(const scp_core *core, double cost, double slack, const double *excess)
{
    return cost + core->p.slack_weight * slack +
           dot(core->at.N * core->at.nb, core->row_price, excess);
}

/* ---- programs */

void lay_out_program(const scp_core *core, arena *from, program *p)
{
    const layout *at = &core->at;
    size_t all = (size_t)(at->nf + at->most_pairs);
    memset(p, 0, sizeof *p);
    p->c.y_free = doubles(from, (size_t)at->ny);
    p->c.here = doubles(from, (size_t)at->nv);
    p->lower = doubles(from, (size_t)at->nf);
    p->upper = doubles(from, (size_t)at->nf);
    p->b = doubles(from, (size_t)at->most_pairs);
    p->l1_weight = doubles(from, all);
    p->at = ints(from, 2 * (size_t)at->most_pairs);
    if (!core->linear)
        p->W = doubles(from, (size_t)(at->nv * at->nv));
}

static void write_bounds(scp_core *core, const condensed *c, const double *radius, program *to)
{
    const layout *at = &core->at;
    const double *lower, *upper, *free = c->y_free + at->boxed, *u = c->about->u;
    relaxed_bounds(core, to->level, &lower, &upper);
    for (int i = 0; i < at->nf; i++) {
        to->lower[i] = lower[at->boxed + i] - free[i];
        to->upper[i] = upper[at->boxed + i] - free[i];
    }
    if (radius == NULL)
        return;
    for (int i = 0; i < at->n; i++) {
        double middle = u[i] - free[at->inputs + i];
        to->lower[at->inputs + i] = fmax(to->lower[at->inputs + i], middle - radius[i]);
        to->upper[at->inputs + i] = fmin(to->upper[at->inputs + i], middle + radius[i]);
    }
}

static void write_weights(const scp_core *core, program *to)
{
    const layout *at = &core->at;
    double obstacles = to->level == RELAX_ALL ? core->p.slack_weight : INFINITY;
    fill(at->nf, INFINITY, to->l1_weight);
    for (int i = 0; i < at->N * at->nb; i++)
        if (core->p.row_soft[i % at->nb])
            to->l1_weight[at->states + i] = core->p.state_slack_weight;
    fill(to->qp.pairs, obstacles, to->l1_weight + at->nf);
}

/* The values of the convex program about a plan, whose pairs it holds.
 *
 * c: the problem condensed about it. spaces: half-spaces of its pairs. radius: (N nu,) by how much
 * inputs may change at most, or NULL. */
void write_program(scp_core *core, const nominal *about, const condensed *c, const planes *spaces,
                   relaxation level, const double *radius, program *to)
{
    const layout *at = &core->at;
    int d = at->d;
    to->c = *c;
    to->about = about;
    to->planes = *spaces;
    to->level = level;
    to->bent = 0;
    for (int k = 0; k < about->pairs.count; k++) {
        const double *a = spaces->a + k * (d + 1);
        int p = at->p + about->pairs.node[k] * d, s = at->s + about->pairs.obstacle[k];
        double b = a[d] * (spaces->y[s] - c->y_free[s]) - spaces->g[k];
        for (int i = 0; i < d; i++)
            b += a[i] * (spaces->y[p + i] - c->y_free[p + i]);
        to->b[k] = b;
        to->at[2 * k] = p;
        to->at[2 * k + 1] = at->moving ? s : -1;
    }
    qp values = {
        .nv = at->nv, .nf = at->nf, .pairs = about->pairs.count, .d = d, .n = at->n,
        .F = c->by->S + at->boxed * at->nv, .lower = to->lower, .upper = to->upper,
        .a = spaces->a, .S = c->by->S, .at = to->at, .b = to->b, .least = c->least,
    };
    to->qp = values;
    write_bounds(core, c, radius, to);
    if (level != RELAX_NONE) {
        write_weights(core, to);
        to->qp.l1_weight = to->l1_weight;
    }
}

/* The active set that forces name: who pushes, and at the largest force yields. */
void guess_active(const program *p, const double *reaction, const double *force, solution *to)
{
    int nf = p->qp.nf, all = nf + p->qp.pairs;
    for (int i = 0; i < all; i++) {
        double push = i < nf ? reaction[i] : force[i - nf];
        to->active[i] = (int8_t)(push > 0 ? -1 : push < 0 ? i < nf : 0);
        to->relaxed[i] = to->active[i] != 0 && p->qp.l1_weight != NULL &&
                         fabs(push) >= p->qp.l1_weight[i] * (1 - AT_WEIGHT);
    }
}

/* `settle`, with as many changes as there is time for. */
qp_end settle_in_time(scp_core *core, const program *p, int changes, double limit, solution *to)
{
    int systems = 0, most = room_for(core, TASK_REPAIR, changes, TASK_NONE, 0);
    lap began = mark_time(core);
    qp_end end = settle(core, &p->qp, to, most, limit, &systems);
    learn_time(core, TASK_REPAIR, began, systems);
    return end;
}

/* No constraint is active. */
void guess_nothing(const program *p, solution *to)
{
    memset(to->active, 0, (size_t)(p->qp.nf + p->qp.pairs) * sizeof *to->active);
    memset(to->relaxed, 0, (size_t)(p->qp.nf + p->qp.pairs) * sizeof *to->relaxed);
}

/* Solve a program from a plan and its multipliers, or else from nothing. */
program_end solve_program(scp_core *core, const program *p, const nominal *from, solution *to)
{
    guess_active(p, from->reaction, from->force, to);
    qp_end end = settle_in_time(core, p, CHANGES, INFINITY, to);
    if (end == QP_UNSOLVED) {
        if (!allows(core, TASK_LONGER_RUN))
            return PROGRAM_LATE;
        lap began = mark_time(core);
        guess_nothing(p, to);
        end = settle_in_time(core, p, MOST_CHANGES, INFINITY, to);
        learn_time(core, TASK_LONGER_RUN, began, 1);
    }
    core->out.solved += end == QP_SOLVED;
    core->out.infeasible += end == QP_INFEASIBLE;
    return end == QP_SOLVED ? PROGRAM_SOLVED : PROGRAM_UNSOLVED;
}

/* Roll a solution out and certify it against the original problem. The cost is NaN where that does
 * not lead anywhere. */
void certified(scp_core *core, const program *p, const solution *s, nominal *to)
{
    const layout *at = &core->at;
    const double *lower, *upper, *free = p->c.y_free + at->boxed;
    int nf = at->nf, count = at->inputs + at->n;
    size_t mark = core->scratch.used;
    double *boxed = doubles(&core->scratch, (size_t)count);
    double *e = core->linear ? NULL : doubles(&core->scratch, (size_t)(at->N * at->nx));
    relaxed_bounds(core, p->level, &lower, &upper);
    gemv(count, at->nv, p->qp.F, s->v, boxed);
    for (int i = 0; i < count; i++) { /* bounds are met exactly, not nearly */
        double low = lower[at->boxed + i], high = upper[at->boxed + i];
        boxed[i] += free[i];
        boxed[i] = fabs(boxed[i] - low) <= ROUNDING ? low : boxed[i];
        boxed[i] = fabs(boxed[i] - high) <= ROUNDING ? high : boxed[i];
    }
    if (e != NULL)
        deviations_of(core, &p->c, s->v, e);
    const double *sizes = at->moving ? boxed : p->c.y_free + at->s;
    int failed = rolled(core, boxed + at->inputs, sizes, e, to);
    core->scratch.used = mark;
    copy_pairs(core, &p->about->pairs, &to->pairs);
    memcpy(to->reaction, s->force, (size_t)nf * sizeof(double));
    memcpy(to->force, s->force + nf, (size_t)to->pairs.count * sizeof(double));
    if (failed)
        to->cost = NAN;
    else
        judge_plan(core, to, s->relaxed + nf, p->level);
}

/* ---- a linear robot's plan that ignores the obstacles */

/* A plan of a convex problem, whose least curvature is that of its cost. */
static int convex(scp_core *core, nominal *to)
{
    core->out.kkt++;
    to->kkt.curvature = 1.0;
    return 1;
}

/* From the bounds where another one is. No more than a few linear systems: the program has only
 * bounds, and few of them change from step to step. 0 where that does not lead to it. */
int obstacle_free_optimum(scp_core *core, const scp_iterate *guess, nominal *to)
{
    const layout *at = &core->at;
    program *p = &core->work->program;
    solution *found = &core->work->convex;
    const double *lower, *upper, *free = p->c.y_free;
    int inside = 1, systems = 0;
    size_t mark = core->scratch.used;
    double *rest = doubles(&core->scratch, (size_t)at->n);
    for (int i = 0; i < at->n; i++)
        rest[i] = core->p.rest[i % at->nu];
    core->broken |= rolled(core, rest, core->work->full, NULL, to) ||
                    condense(core, &to->roll, core->work->full, NULL, &p->c);
    core->scratch.used = mark;
    if (core->broken)
        return 0;
    relaxed_bounds(core, RELAX_NONE, &lower, &upper);
    for (int i = at->boxed; i < at->ny; i++)
        inside &= lower[i] <= free[i] && free[i] <= upper[i];
    if (inside)
        return !plain_nominal(core, free + at->u, NULL, to) && convex(core, to);
    make_pairs(core, core->work->nobody, &to->pairs);
    write_program(core, to, &p->c, &to->planes, RELAX_NONE, NULL, p);
    fill(at->nf, 0.0, found->force);
    if (guess != NULL && guess->has_multipliers)
        reaction_of(core, guess, found->force);
    guess_active(p, found->force, NULL, found);
    int most = room_for(core, TASK_REPAIR, REPAIRS, TASK_ITERATION, 0);
    lap began = mark_time(core);
    qp_end end = settle(core, &p->qp, found, most, INFINITY, &systems);
    learn_time(core, TASK_REPAIR, began, systems);
    if (end != QP_SOLVED)
        return 0;
    certified(core, p, found, to);
    return convex(core, to);
}

/* ---- what is handed out */

/* Y (ny,) of an iterate's own states, which need not be where its inputs lead. */
void iterate_outputs(scp_core *core, const scp_iterate *it, double *y)
{
    const layout *at = &core->at;
    int C = at->nodes.size, d = at->d, nx = at->nx;
    size_t mark = core->scratch.used;
    double *p = doubles(&core->scratch, (size_t)(C * d));
    double *e = doubles(&core->scratch, (size_t)(at->N * nx));
    nodes_positions(core, at->nodes, it->states, it->inputs, p);
    for (int k = 0; k < C * d; k++)
        p[k] -= core->now->x0[core->p.position[k % d]];
    for (int i = 0; i < at->N * nx; i++)
        e[i] = it->states[nx + i] - core->now->x_ref[nx + i];
    outputs_of(core, p, it->s, it->inputs, e, y);
    core->scratch.used = mark;
}

/* Whether an obstacle may shape this point: an active constraint, or no multipliers. */
int touches(const scp_core *core, const scp_iterate *it)
{
    for (int k = 0; k < core->at.most_pairs; k++)
        if (it->has_multipliers && it->obstacles[k] < -NEGLIGIBLE)
            return 1;
    return !it->has_multipliers;
}

/* States (N+1, nx) of a plan. */
void states_of(const scp_core *core, const rollout *roll, double *X)
{
    int nx = core->at.nx;
    memcpy(X, core->now->x0, (size_t)nx * sizeof *X);
    for (int i = 0; i < core->at.N * nx; i++)
        X[nx + i] = core->now->x_ref[nx + i] + roll->e[i];
}

static void name_bounds(const scp_core *core, const nominal *n, scp_iterate *to)
{
    const layout *at = &core->at;
    for (int j = 0; j < at->M; j++)
        to->margin[j] = j < at->moving ? -n->reaction[j] : 0.0;
    for (int i = 0; i < at->n; i++)
        to->input_bounds[i] = -n->reaction[at->inputs + i];
    for (int i = 0; i < at->rated; i++)
        to->rates[i] = -n->reaction[at->rates + i];
    for (int i = 0; i < at->N * at->nb; i++)
        to->state_bounds[i] = -n->reaction[at->states + i];
}

/* Name the parts of a plan in the words of the problem; no force beyond `l1_weight`. */
void name_iterate(const scp_core *core, const nominal *n, double l1_weight, scp_iterate *to)
{
    const layout *at = &core->at;
    int C = at->nodes.size, d = at->d, slots = at->most_pairs;
    double most = isfinite(l1_weight) ? l1_weight : 0.0;
    states_of(core, &n->roll, to->states);
    memcpy(to->inputs, n->roll.u, (size_t)at->n * sizeof(double));
    memcpy(to->s, n->y + at->s, (size_t)at->M * sizeof(double));
    memcpy(to->dynamics, n->costates, (size_t)(at->N * at->nx) * sizeof(double));
    to->has_multipliers = 1;
    name_bounds(core, n, to);
    fill(slots, 0.0, to->slack);
    fill(slots, 0.0, to->obstacles);
    fill(slots, -most, to->pins);
    for (int k = 0; k < n->pairs.count; k++) {
        int j = n->pairs.obstacle[k], pair = j * C + n->pairs.node[k];
        to->slack[pair] = n->slack[k];
        to->obstacles[pair] = -n->force[k];
        to->pins[pair] = n->force[k] - most;
        if (!at->moving) /* the bound takes whatever pushes a size that cannot move */
            to->margin[j] += n->force[k] * n->planes.a[k * (d + 1) + d];
    }
}
