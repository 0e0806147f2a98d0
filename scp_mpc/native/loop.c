/* Sequential convex programming: the loop. scp_mpc/scp/loop.py, trust_region.py, and judge of
 * plan.py.
 *
 *     now      the plan to start from
 *     repeat:  linearise   the dynamics about the plan
 *              write       their values, and half-spaces of near obstacles
 *              solve       from the active set of the plan
 *              refine      Newton's step on the active set found, where it exists (newton.c)
 *              certify     the plan it leads to, against the original problem (certificate.c)
 *              screen      whether that plan violates a pair of obstacle and node that was left out
 *              accept      the plan as the next one, or trust a smaller region
 *     until    certified, or the time is up
 *
 * For a linear robot half-spaces are sound about any point, and all plans are accepted. For a
 * nonlinear robot a trust region bounds what the inputs change by; the merit that decides is cost
 * and penalty on all violations, whose weight exceeds the forces met so far. */
#include "core.h"

static const double SURPLUS = 0.1;    /* of the tolerance: worth one more iteration */
static const double LEAST_COST = 1e-3; /* relative to which products of forces are judged */
static const int PATIENCE = 3;        /* iterations before a run towards a goal is given up */
static const double FAR = 1.1;        /* share of the goal's merit above which it is */
static const double NEARLY = 0.01;    /* [m]: a violation that may be mended */
static const double ALIKE = 0.01;     /* relative difference of plans that may become the same */
static const double CLOSE = 0.1;      /* share of the inputs' range that lies between those */
static const double NEGLIGIBLE = 1e-6; /* force that is none */
static const double FLAT = 1e-6;      /* of the largest curvature: the certificate's tolerance */

static const double ENOUGH = 0.01;    /* share of the predicted decrease that a trial must bring */
static const double SHRINK = 0.3, GROW = 3.0;
static const double SMALLEST = 1e-8;  /* relative to the inputs' range, at which to give up */
static const double SLOW = 1e-2;      /* KKT residual from which on its fall counts */
static const double NOISE = 1e-12;    /* of the merit, relative */

typedef struct {
    nominal pool[3]; /* the plan now, the last one that was accepted, and the next */
    planes about;    /* half-spaces about another point than the plan */
    double *span;    /* (N nu,) half the inputs' range */
    double *radius, *direction; /* (N nu,) */
    uint8_t *near;   /* (M, C) */
} loop_room;

/* By how much inputs may change, and what violations weigh. */
typedef struct {
    double size, weight;
    const double *radius; /* (N nu,), NULL for no limit */
} trust_region;

void lay_out_loop(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    loop_room *kept = take(from, 1, sizeof *kept), l;
    for (int i = 0; i < 3; i++)
        lay_out_nominal(core, from, &l.pool[i]);
    l.about.y = doubles(from, (size_t)at->ny);
    l.about.g = doubles(from, (size_t)at->most_pairs);
    l.about.a = doubles(from, (size_t)(at->most_pairs * (at->d + 1)));
    int bends = core->p.max_shapes ? at->d * (at->d - 1) : 0;
    l.about.bend = doubles(from, (size_t)(at->most_pairs * bends));
    l.span = doubles(from, (size_t)at->n);
    l.radius = doubles(from, (size_t)at->n);
    l.direction = doubles(from, (size_t)at->n);
    l.near = bytes(from, (size_t)at->most_pairs);
    core->loop = kept;
    if (kept != NULL)
        *kept = l;
}

void set_up_loop(scp_core *core)
{
    loop_room *l = core->loop;
    for (int i = 0; i < core->at.n; i++) {
        int k = i % core->at.nu;
        double span = (core->p.u_max[k] - core->p.u_min[k]) / 2;
        l->span[i] = span > 0 ? span : 1.0;
    }
}

size_t scratch_of_loop(const scp_core *core)
{
    const layout *at = &core->at;
    size_t path = (size_t)((2 * at->nodes.size + 1) * at->d);
    return path * sizeof(double) + 2 * (size_t)at->most_pairs + 4 * 64;
}

double worst_of(const residuals *r)
{
    double sum = r->stationarity + r->feasibility + r->complementarity;
    return isnan(sum) ? INFINITY : fmax(fmax(r->stationarity, r->feasibility), r->complementarity);
}

/* ---- trust region */

static void resize(const scp_core *core, trust_region *trust, double size)
{
    loop_room *l = core->loop;
    trust->size = size;
    trust->radius = isfinite(size) ? l->radius : NULL;
    for (int i = 0; i < core->at.n; i++)
        l->radius[i] = size * l->span[i];
}

/* Cost and penalties on all violations, whoever is supposed to yield. */
static double merit_now(const scp_core *core, const trust_region *trust, const nominal *n)
{
    double depth = 0.0;
    for (int k = 0; k < n->pairs.count; k++)
        depth += fmax(0.0, -n->planes.g[k]);
    return merit_of(core, n->cost, 0.0, n->excess) + trust->weight * depth;
}

/* Whether a trial brings enough of what its program predicted. */
static int accepts(scp_core *core, trust_region *trust, const nominal *now, const nominal *reached,
                   const nominal *trial, program *p, const solution *convex,
                   const solution *refined)
{
    double slack_weight = core->p.slack_weight;
    if (!isfinite(trial->cost))
        return 0;
    if (core->linear)
        return 1;
    double largest = largest_abs(p->qp.pairs, convex->force + p->qp.nf);
    trust->weight = fmin(fmax(trust->weight / 2, 2 * largest), slack_weight);
    if (p->level == RELAX_ALL)
        trust->weight = slack_weight;
    double before = merit_now(core, trust, now), after = merit_now(core, trust, trial);
    double bent = bent_by(core, p, convex, refined->v);
    double predicted = before - qp_merit(core, &p->qp, refined->v) - bent;
    if (before - after >= ENOUGH * predicted - NOISE * fabs(before)) {
        if (before - after >= predicted / 2)
            resize(core, trust, GROW * trust->size);
        return 1;
    }
    double worst = reached == NULL ? INFINITY : worst_of(&now->kkt);
    return worst_of(&trial->kkt) <= worst / 2 && worst / 2 <= SLOW;
}

/* Trust only a part of the way that the inputs were to go; 0 where that is none. */
static int shrinks(const scp_core *core, trust_region *trust, const nominal *now, const program *p,
                   const solution *refined)
{
    const layout *at = &core->at;
    const loop_room *l = core->loop;
    double most = 0.0;
    for (int i = 0; i < at->n; i++) {
        const double *row = p->c.by->S + (at->u + i) * at->nv;
        double u = p->c.y_free[at->u + i] + dot(at->nv, row, refined->v);
        double change = fabs(u - now->y[at->u + i]) / l->span[i];
        most = change <= most ? most : change; /* or NaN */
    }
    resize(core, trust, SHRINK * fmin(trust->size, most));
    return trust->size >= SMALLEST;
}

/* ---- what became of a run */

static int is_any(int n, const double *a)
{
    for (int i = 0; i < n; i++)
        if (a[i] != 0)
            return 1;
    return 0;
}

static int yields(const scp_core *core, const nominal *n)
{
    return is_any(n->pairs.count, n->slack) || is_any(core->at.N * core->at.nb, n->excess);
}

static double deepest(const scp_core *core, const nominal *n)
{
    return fmax(largest_abs(n->pairs.count, n->slack),
                largest_abs(core->at.N * core->at.nb, n->excess));
}

/* Whether a plan is certified, and another iteration would hardly better it. */
static int is_converged(const scp_core *core, const nominal *trial, double before)
{
    double tolerance = core->p.tolerance;
    double product = trial->kkt.complementarity / fmin(1.0, fmax(trial->cost, LEAST_COST));
    double enough = before <= tolerance ? tolerance : SURPLUS * tolerance;
    return fmax(worst_of(&trial->kkt), product) <= enough;
}

/* Whether plans without obstacles are close. */
static int is_close(const scp_core *core, const double *u, const double *v)
{
    for (int i = 0; i < core->at.n; i++) {
        int k = i % core->at.nu;
        if (!(fabs(u[i] - v[i]) <= CLOSE * (core->p.u_max[k] - core->p.u_min[k])))
            return 0;
    }
    return 1;
}

/* Whether a run, whose cost falls by ever less, is far above its goal or ends there. */
static int is_dominated(scp_core *core, int iterations, const nominal *trial, const result *goal)
{
    int C = core->at.nodes.size, d = core->at.d, count = core->now->J * C;
    if (is_ok(goal->status) && iterations >= PATIENCE && trial->cost > FAR * goal->merit)
        return 1;
    if (fabs(trial->cost - goal->cost) > ALIKE * goal->cost)
        return 0;
    if (!trial->pairs.count)
        return is_close(core, trial->roll.u, goal->it.inputs);
    size_t mark = core->scratch.used;
    double *mine = doubles(&core->scratch, (size_t)((C + 1) * d));
    double *theirs = doubles(&core->scratch, (size_t)(C * d));
    uint8_t *touched = bytes(&core->scratch, (size_t)count);
    uint8_t *there = bytes(&core->scratch, (size_t)count);
    path_of(core, trial->y, mine);
    nodes_positions(core, core->at.nodes, goal->it.states, goal->it.inputs, theirs);
    memset(touched, 0, (size_t)count);
    for (int k = 0; k < trial->pairs.count; k++)
        touched[trial->pairs.obstacle[k] * C + trial->pairs.node[k]] = trial->force[k] > NEGLIGIBLE;
    for (int k = 0; k < count; k++)
        there[k] = goal->it.has_multipliers && goal->it.obstacles[k] < -NEGLIGIBLE;
    int same = same_pattern(core, mine + d, touched, theirs, there);
    core->scratch.used = mark;
    return same;
}

/* Whether a nonlinear robot's plan violates its constraints, but hardly. */
static int is_nearly_feasible(const scp_core *core, const nominal *n)
{
    double tolerance = core->p.tolerance, deep = fmax(n->kkt.feasibility, deepest(core, n));
    return !core->linear && worst_of(&n->kkt) > tolerance && tolerance < deep && deep <= NEARLY;
}

static scp_status judge(const residuals *r, double slack, double tolerance)
{
    int outside = !(r->feasibility <= tolerance && slack <= tolerance); /* or NaN */
    if (worst_of(r) <= tolerance && !isnan(slack) && r->curvature >= -FLAT) /* not NaN, unknown */
        return outside ? SCP_SOFTENED : SCP_CONVERGED;
    return outside ? SCP_VIOLATING : SCP_FEASIBLE;
}

void judge_nominal(scp_core *core, const nominal *n, relaxation level, int iterations, result *to)
{
    double slack = 0.0, tolerance = core->p.tolerance;
    if (n != &to->at)
        copy_nominal(core, n, &to->at);
    n = &to->at;
    to->status = judge(&n->kkt, deepest(core, n), tolerance);
    if (!is_certified(to->status) && n->kkt.feasibility > tolerance) /* then all of it counts */
        for (int k = 0; k < n->pairs.count; k++)
            n->slack[k] = fmax(-n->planes.g[k], 0.0);
    for (int k = 0; k < n->pairs.count; k++)
        slack += n->slack[k];
    to->cost = n->cost;
    to->merit = merit_of(core, n->cost, slack, n->excess);
    to->kkt = n->kkt;
    to->iterations = iterations;
    to->there = to->has_nominal = 1;
    name_iterate(core, n, level == RELAX_ALL ? core->p.slack_weight : INFINITY, &to->it);
}

int is_ok(scp_status status) { return status <= SCP_BRAKING; }

int is_certified(scp_status status) { return status == SCP_CONVERGED || status == SCP_SOFTENED; }

/* Whether one plan is safe and the other is not, or its merit is better by `lead`. */
int beats(const result *one, const result *other, double lead)
{
    if (is_ok(one->status) != is_ok(other->status))
        return is_ok(one->status);
    if (!is_ok(one->status) && is_certified(one->status) != is_certified(other->status))
        return is_certified(one->status);
    return one->merit < other->merit - lead;
}

/* ---- the loop */

static nominal *spare(loop_room *l, const nominal *one, const nominal *other)
{
    nominal *free = l->pool;
    while (free == one || free == other)
        free++;
    return free;
}

static const planes *planes_about(scp_core *core, const pairs *of, const double *y)
{
    loop_room *l = core->loop;
    if (y != l->about.y)
        memcpy(l->about.y, y, (size_t)core->at.ny * sizeof *y);
    find_planes(core, core->now, of, l->about.y, &l->about);
    return &l->about;
}

/* One program about a plan, solved, refined and rolled out. */
static program_end follow(scp_core *core, const nominal *now, const planes *half_spaces,
                          relaxation level, const trust_region *trust, const solution **refined,
                          nominal *trial)
{
    workspace *work = core->work;
    program *p = &work->program;
    lap began = mark_time(core);
    if (condense(core, &now->roll, now->y + core->at.s, &work->by, &p->c)) {
        core->broken = 1;
        return PROGRAM_LATE;
    }
    write_program(core, now, &p->c, half_spaces, level, trust->radius, p);
    program_end end = solve_program(core, p, now, &work->convex);
    if (end == PROGRAM_SOLVED) {
        *refined = refine(core, p, &work->convex);
        certified(core, p, *refined, trial);
    }
    learn_time(core, TASK_ITERATION, began, 1);
    return end;
}

/* The last plan of a run becomes a result. */
static void finish(scp_core *core, nominal *reached, const solution *s, relaxation level,
                   int iterations, result *to)
{
    loop_room *l = core->loop;
    const program *p = &core->work->program;
    if (worst_of(&reached->kkt) <= core->p.tolerance && isnan(reached->kkt.curvature) && s != NULL)
        second_order(core, p, s, reached, l->direction);
    if (is_nearly_feasible(core, reached)) { /* out of iterations: a plan that can be followed */
        nominal *one = spare(l, reached, NULL);
        nominal *near = restored(core, reached, one, spare(l, reached, one));
        level = near != NULL ? RELAX_NONE : level;
        reached = near != NULL ? near : reached;
    }
    nominal kept = to->at;
    to->at = *reached;
    *reached = kept;
    judge_nominal(core, &to->at, level, iterations, to);
}

void run_loop(scp_core *core, const nominal *start, const result *goal, const double *about_y,
              int limit, int hard, result *to)
{
    loop_room *l = core->loop;
    program *p = &core->work->program;
    const solution *convex = &core->work->convex, *refined = NULL;
    const nominal *now = start;
    const planes *half_spaces = &start->planes;
    nominal *reached = NULL; /* the last plan that was accepted */
    trust_region trust = {INFINITY, 0.0, NULL};
    relaxation level = RELAX_NONE;
    int iterations = 0, most = limit ? limit : core->p.max_iterations;
    to->there = 0;
    if (about_y != NULL)
        half_spaces = planes_about(core, &start->pairs, about_y);
    while (iterations < most && !core->broken && allows(core, TASK_ITERATION)) {
        nominal *trial = spare(l, now, reached);
        program_end end = follow(core, now, half_spaces, level, &trust, &refined, trial);
        if (end != PROGRAM_SOLVED) {
            refined = NULL;
            if (end == PROGRAM_LATE || !relaxes(core, &level, hard || !now->pairs.count))
                break;
            continue; /* no solution, or none found: the next ones may yield */
        }
        iterations++;
        if (screen(core, trial, l->near)) { /* who was left out enters, and it is solved again */
            int own = half_spaces == &now->planes;
            with_pairs(core, now, l->near, trial);
            half_spaces = own ? &trial->planes
                              : planes_about(core, &trial->pairs, half_spaces->y);
            now = trial;
            refined = NULL;
            continue;
        }
        int accepted = accepts(core, &trust, now, reached, trial, p, convex, refined);
        if (!accepted && !core->linear && trial->pairs.count) {
            refined = second_order_correction(core, p, refined, trial);
            certified(core, p, refined, trial);
            accepted = accepts(core, &trust, now, reached, trial, p, convex, refined);
        }
        if (!accepted && !shrinks(core, &trust, now, p, refined))
            break;
        if (!accepted)
            continue;
        double before = reached == NULL ? INFINITY : worst_of(&reached->kkt);
        now = reached = trial;
        half_spaces = &trial->planes;
        level = yields(core, trial) ? level : RELAX_NONE;
        if (is_converged(core, trial, before)) {
            nominal *away = spare(l, trial, NULL);
            second_order(core, p, refined, trial, l->direction);
            if (!negative_curvature_step(core, trial, l->direction, away))
                break;
            now = away;
            half_spaces = &away->planes;
            continue;
        }
        if (goal != NULL && is_dominated(core, iterations, trial, goal))
            return;
    }
    if (reached != NULL && !core->broken)
        finish(core, reached, refined, level, iterations, to);
}
