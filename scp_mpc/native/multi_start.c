/* Multi-start: other candidates past the obstacles against the plan that is there.
 * scp_mpc/scp/multi_start.py.
 *
 * All are ranked by the programs that linearise about them, solved as far as they can win: the dual
 * objective bounds a program's optimum from below, and so do the multipliers that the same one had
 * one control step before. The best are followed to their end, and win if they are better by
 * enough. Where the plan needs slack, more are followed until one does not. Waiting in front of an
 * obstacle is cheap over a short horizon, which does not show what it costs in the end: it has to
 * promise half of the plan's cost. */
#include "core.h"

/* It must be better by this share, or the plan flickers between candidates of equal cost. */
static const double HYSTERESIS = 0.001;
static const double PROMISING = 0.5; /* share of the plan's merit that is much less */
static const double CUTOFF = 3.0;    /* times the plan's own merit: more than that does not win */
static const double ALIKE = 1e-6;    /* relative difference of merits that counts as none */
static const double NEGLIGIBLE = 1e-6; /* force that is none */
enum {
    MOST = 16,            /* candidates, */
    MOST_AMONG_WALLS = 32, /* the same where there are polytopes, one that waits apart */
    MOST_FOLLOWED = 8,    /* where the plan needs slack */
    MOST_PROMISING = 3,   /* where others promise to cost much less */
    BEAM = 3,             /* candidates among polytopes that are varied */
    ROUNDS = 5,           /* of variations */
    CHANGES = 50,         /* of the active set, before what is known of it is forgotten, */
    MOST_CHANGES = 4000   /* and in all */
};

/* What one program about a path seems to lead to. */
typedef struct {
    double merit;     /* of its optimum; infinite if it has no solution, or none that can win */
    int looked, wins; /* whether there was time for it, and whether it may win */
    int waits, varied;
    int yields;       /* whether obstacles do in its program */
    double *path;     /* (C, d) */
    double *v;        /* (nv,) */
    double *force;    /* (nf + M C,) */
} ranked;

/* Which candidates were looked at: an obstacle's come in the same order in each step. */
typedef struct {
    int count;
    int obstacle[SCP_MOST_CANDIDATES], number[SCP_MOST_CANDIDATES]; /* -1: no time */
} alternatives;

typedef struct {
    nominal plan;        /* about which all programs are condensed, with the pairs that they hold */
    nominal start;
    sensitivity by;      /* of a nonlinear robot */
    program program;
    pairs few;           /* those that push in the step before */
    planes about;        /* half-spaces about a path */
    solution solution;
    result end;
    candidate_path paths[SCP_MOST_CANDIDATES];
    ranked base[SCP_MOST_CANDIDATES], beam[BEAM], next[BEAM], more[MOST_AMONG_WALLS];
    double *variations;  /* (MOST_AMONG_WALLS, C, d) */
    uint8_t *here;       /* (M, C) who pushes the plan that is there */
    double *here_path;   /* (C+1, d) */
    alternatives known, made; /* in the step before, whose forces these are, and in this one */
    double *force[SCP_MOST_CANDIDATES]; /* (nf + M C,) */
} multi_room;

static void lay_out_ranked(const scp_core *core, arena *from, ranked *one)
{
    const layout *at = &core->at;
    one->path = doubles(from, (size_t)(at->nodes.size * at->d));
    one->v = doubles(from, (size_t)at->nv);
    one->force = doubles(from, (size_t)(at->nf + at->most_pairs));
}

static int most_candidates(const scp_core *core)
{
    return core->at.M == 0 ? 0 : 1 + (core->p.max_shapes ? MOST_AMONG_WALLS : MOST);
}

static void lay_out_walls(const scp_core *core, arena *from, multi_room *room)
{
    const layout *at = &core->at;
    for (int i = 0; i < BEAM; i++) {
        lay_out_ranked(core, from, &room->beam[i]);
        lay_out_ranked(core, from, &room->next[i]);
    }
    for (int i = 0; i < MOST_AMONG_WALLS; i++)
        lay_out_ranked(core, from, &room->more[i]);
    room->variations = doubles(from, (size_t)(MOST_AMONG_WALLS * at->nodes.size * at->d));
}

void lay_out_multi_start(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    multi_room *kept = take(from, 1, sizeof *kept);
    multi_room measured, *room = kept != NULL ? kept : &measured;
    size_t slots = (size_t)at->most_pairs, d = (size_t)at->d;
    memset(room, 0, sizeof *room);
    core->multi = kept;
    if (!at->M)
        return;
    lay_out_nominal(core, from, &room->plan);
    lay_out_nominal(core, from, &room->start);
    if (!core->linear)
        lay_out_sensitivity(core, from, &room->by);
    lay_out_program(core, from, &room->program);
    room->few.obstacle = ints(from, slots);
    room->few.node = ints(from, slots);
    room->about.y = doubles(from, (size_t)at->ny);
    room->about.g = doubles(from, slots);
    room->about.a = doubles(from, slots * (d + 1));
    room->about.bend = doubles(from, core->p.max_shapes ? slots * d * (d - 1) : 0);
    lay_out_solution(core, from, &room->solution);
    lay_out_result(core, from, &room->end);
    room->here = bytes(from, slots);
    room->here_path = doubles(from, (size_t)((at->nodes.size + 1) * at->d));
    for (int i = 0; i < most_candidates(core); i++) {
        lay_out_ranked(core, from, &room->base[i]);
        room->paths[i].path = room->base[i].path;
        room->force[i] = doubles(from, (size_t)at->nf + slots);
    }
    if (core->p.max_shapes)
        lay_out_walls(core, from, room);
}

size_t scratch_of_multi_start(const scp_core *core)
{
    const layout *at = &core->at;
    size_t path = (size_t)((at->nodes.size + 1) * at->d), slots = (size_t)at->most_pairs;
    size_t reals = 2 * path + (size_t)(at->ny + at->nf) + slots + SCP_MOST_CANDIDATES;
    return reals * sizeof(double) + 3 * slots + (size_t)at->nf + 10 * 64;
}

/* ---- memory of the alternatives */

void forget_alternatives(scp_core *core)
{
    multi_room *room = core->multi;
    room->made.count = 0;
}

void ignore_alternatives(scp_core *core)
{
    multi_room *room = core->multi;
    room->known.count = 0;
}

/* What this step has found out is known in the next one, shifted by one stage. */
void shift_alternatives(scp_core *core)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    int C = at->nodes.size, stage = at->nodes.count;
    room->known = room->made;
    room->made.count = 0;
    for (int i = 0; i < room->known.count; i++) {
        double *force = room->base[i].force, *inputs = force + at->inputs, *pushes = force + at->nf;
        room->base[i].force = room->force[i];
        room->force[i] = force;
        memmove(inputs, inputs + at->nu, (size_t)(at->n - at->nu) * sizeof *inputs);
        for (int j = 0; j < at->M; j++, pushes += C)
            memmove(pushes, pushes + stage, (size_t)(C - stage) * sizeof *pushes);
    }
}

void memo_alternatives(scp_core *core, memo *m)
{
    multi_room *room = core->multi;
    size_t size = (size_t)core->at.nf + (size_t)core->at.most_pairs;
    memo_ints(m, 1, &room->made.count);
    memo_ints(m, SCP_MOST_CANDIDATES, room->made.obstacle);
    memo_ints(m, SCP_MOST_CANDIDATES, room->made.number);
    for (int i = 0; i < SCP_MOST_CANDIDATES; i++) /* as many, whatever a core has room for */
        memo_doubles(m, size, i < most_candidates(core) ? room->base[i].force : NULL);
    if (room->made.count > most_candidates(core))
        room->made.count = most_candidates(core);
}

static const double *known_force(const multi_room *room, int obstacle, int number)
{
    for (int i = 0; i < room->known.count; i++)
        if (room->known.obstacle[i] == obstacle && room->known.number[i] == number)
            return room->force[i];
    return NULL;
}

/* ---- the plan that is there */

static int pair_of(const scp_core *core, const pairs *of, int k)
{
    return of->obstacle[k] * core->at.nodes.size + of->node[k];
}

/* Whether to try: an obstacle is entered, or shapes a plan that is not safe or is due. Not where no
 * program was solved: there is no time. Nor where no obstacle has to do with what is wrong, as with
 * a start outside the states' bounds. */
int multi_start_wanted(const scp_core *core, const result *best, int due)
{
    if (!core->p.multi_start || !best->has_nominal || !core->at.M)
        return 0;
    int clear = largest_abs(core->at.most_pairs, best->it.slack) <= core->p.tolerance;
    return !clear || ((due || !is_ok(best->status)) && touches(core, &best->it));
}

static void away_from_here(const scp_core *core, const double *path, double *y)
{
    const layout *at = &core->at;
    for (int k = 0; k < at->nodes.size * at->d; k++)
        y[at->p + k] = path[k] - core->now->x0[core->p.position[k % at->d]];
}

/* Condense about the plan that is there, with all pairs near to it or to the free one. */
static int become_incumbent(scp_core *core, const result *best, const double *free_path)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    nominal *plan = &room->plan;
    size_t mark = core->scratch.used;
    double *alone = doubles(&core->scratch, (size_t)at->ny);
    double *push = doubles(&core->scratch, (size_t)at->most_pairs);
    uint8_t *near = bytes(&core->scratch, (size_t)at->most_pairs);
    copy_nominal(core, &best->at, plan);
    memcpy(alone, plan->y, (size_t)at->ny * sizeof *alone);
    away_from_here(core, free_path, alone);
    near_pairs(core, plan->y, core->work->nobody, near);
    near_pairs(core, alone, near, near);
    memset(push, 0, (size_t)at->most_pairs * sizeof *push);
    for (int k = 0; k < plan->pairs.count; k++)
        push[pair_of(core, &plan->pairs, k)] = plan->force[k];
    make_pairs(core, near, &plan->pairs);
    for (int k = 0; k < plan->pairs.count; k++)
        plan->force[k] = push[pair_of(core, &plan->pairs, k)];
    core->scratch.used = mark;
    core->broken |= condense(core, &plan->roll, plan->y + at->s, &room->by, &room->program.c);
    return !core->broken;
}

/* The outputs that a path means: (ny,) in room->about.y. */
static void take_path(scp_core *core, const double *path)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    memcpy(room->about.y, room->plan.y, (size_t)at->ny * sizeof(double));
    memcpy(room->about.y + at->s, core->work->full, (size_t)at->M * sizeof(double));
    away_from_here(core, path, room->about.y);
}

/* How the point that a program reached passes the obstacles: (C+1, d) from now on, and (J, C). */
static void passing(scp_core *core, const ranked *one, double *path, uint8_t *touched)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    size_t mark = core->scratch.used;
    double *y = doubles(&core->scratch, (size_t)at->ny);
    y_of(core, &room->program.c, one->v, y);
    path_of(core, y, path);
    for (int k = 0; k < core->now->J * at->nodes.size; k++)
        touched[k] = one->force[at->nf + k] > NEGLIGIBLE;
    core->scratch.used = mark;
}

static int is_like(scp_core *core, const ranked *one)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    size_t mark = core->scratch.used;
    double *path = doubles(&core->scratch, (size_t)((at->nodes.size + 1) * at->d));
    uint8_t *touched = bytes(&core->scratch, (size_t)at->most_pairs);
    passing(core, one, path, touched);
    int like = same_pattern(core, path + at->d, touched, room->here_path + at->d, room->here);
    core->scratch.used = mark;
    return like;
}

/* The plan to which that point leads, with its multipliers. */
static int start_from(scp_core *core, const ranked *one)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    nominal *to = &room->start;
    size_t mark = core->scratch.used;
    double *y = doubles(&core->scratch, (size_t)at->ny);
    y_of(core, &room->program.c, one->v, y);
    int failed = rolled(core, y + at->u, y + at->s, NULL, to);
    core->scratch.used = mark;
    if (failed)
        return 0;
    make_pairs(core, room->plan.pairs.near, &to->pairs);
    memcpy(to->reaction, one->force, (size_t)at->nf * sizeof(double));
    for (int k = 0; k < to->pairs.count; k++)
        to->force[k] = one->force[at->nf + pair_of(core, &to->pairs, k)];
    judge_plan(core, to, NULL, RELAX_NONE);
    return 1;
}

/* ---- ranking */

/* What multipliers of the step before are worth here: a bound of the program's optimum. */
static double bound_of(scp_core *core, const ranked *one, const double *known, relaxation level)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    nominal about = room->plan;
    size_t mark = core->scratch.used;
    double *force = doubles(&core->scratch, (size_t)(at->nf + at->most_pairs));
    memset(force, 0, (size_t)at->nf * sizeof *force);
    memcpy(force + at->inputs, known + at->inputs, (size_t)at->n * sizeof *force);
    room->few.count = 0;
    for (int k = 0; k < room->plan.pairs.count; k++) {
        int i = pair_of(core, &room->plan.pairs, k), count = room->few.count;
        if (!(known[at->nf + i] > 0))
            continue;
        room->few.obstacle[count] = room->plan.pairs.obstacle[k];
        room->few.node[count] = room->plan.pairs.node[k];
        force[at->nf + count] = known[at->nf + i];
        room->few.count++;
    }
    about.pairs = room->few;
    take_path(core, one->path);
    find_planes(core, core->now, &room->few, room->about.y, &room->about);
    write_program(core, &about, &room->program.c, &room->about, level, NULL, &room->program);
    double bound = dual_bound(core, &room->program.qp, force);
    core->scratch.used = mark;
    return bound;
}

/* Keep forces (nf,) and (K,) of a program as (nf + M C,). */
static void keep_force(const scp_core *core, const double *force, ranked *one)
{
    const layout *at = &core->at;
    const multi_room *room = core->multi;
    const pairs *of = &room->plan.pairs;
    memcpy(one->force, force, (size_t)at->nf * sizeof *force);
    memset(one->force + at->nf, 0, (size_t)at->most_pairs * sizeof *force);
    for (int k = 0; k < of->count; k++)
        one->force[at->nf + pair_of(core, of, k)] = force[at->nf + k];
}

/* The known multipliers of the inputs' bounds and of the pairs that are near now. */
static void keep_known(const scp_core *core, const double *known, ranked *one)
{
    const layout *at = &core->at;
    const multi_room *room = core->multi;
    const pairs *of = &room->plan.pairs;
    memset(one->force, 0, (size_t)(at->nf + at->most_pairs) * sizeof *known);
    memcpy(one->force + at->inputs, known + at->inputs, (size_t)at->n * sizeof *known);
    for (int k = 0; k < of->count; k++)
        one->force[at->nf + pair_of(core, of, k)] = known[at->nf + pair_of(core, of, k)];
}

/* Solve a program from the multipliers of the step before, or those of the plan that is there;
 * where that leads nowhere, from none. */
static qp_end settle_one(scp_core *core, const double *known, double limit)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    const program *p = &room->program;
    solution *s = &room->solution;
    if (known != NULL) {
        for (int k = 0; k < p->qp.pairs; k++)
            s->force[k] = known[at->nf + pair_of(core, &room->plan.pairs, k)];
        guess_active(p, known, s->force, s);
    } else {
        guess_active(p, room->plan.reaction, room->plan.force, s);
    }
    qp_end end = settle_in_time(core, p, CHANGES, limit, s);
    if (end != QP_UNSOLVED)
        return end;
    guess_nothing(p, s);
    return settle_in_time(core, p, MOST_CHANGES, limit, s);
}

/* Whether obstacles yield at the solution of a program. */
static int yields(scp_core *core, const qp *of, const solution *s)
{
    size_t mark = core->scratch.used;
    double *depth = doubles(&core->scratch, (size_t)(of->nf + of->pairs));
    int8_t *side = take(&core->scratch, (size_t)(of->nf + of->pairs), sizeof *side);
    int any = 0;
    violations(core, of, s->v, depth, side);
    for (int k = of->nf; k < of->nf + of->pairs; k++)
        any |= s->relaxed[k] && depth[k] > core->p.tolerance;
    core->scratch.used = mark;
    return any;
}

/* Look at one program; `known` multipliers of the step before may be NULL. */
static void look(scp_core *core, relaxation level, double limit, const double *known, ranked *one)
{
    multi_room *room = core->multi;
    program *p = &room->program;
    solution *s = &room->solution;
    take_path(core, one->path);
    find_planes(core, core->now, &room->plan.pairs, room->about.y, &room->about);
    write_program(core, &room->plan, &p->c, &room->about, level, NULL, p);
    qp_end end = settle_one(core, known, limit);
    keep_force(core, s->force, one);
    one->looked = 1;
    one->merit = end == QP_SOLVED ? qp_merit(core, &p->qp, s->v) : INFINITY;
    one->wins = one->merit <= limit && isfinite(one->merit);
    one->yields = level == RELAX_ALL && one->wins && yields(core, &p->qp, s);
    if (one->wins)
        memcpy(one->v, s->v, (size_t)core->at.nv * sizeof(double));
    else
        one->merit = INFINITY;
    core->out.ranked += one->wins;
    core->out.cut += !one->wins;
}

/* Look at one program about each path, until the deadline. Those come first that seem best by the
 * multipliers of the step before (NULL for unknown): they tell soonest how much the others would
 * have to be worth. A path that waits is no measure for others. */
static int rank(scp_core *core, const result *best, int thorough, int count, ranked *looks,
                const double *const *known)
{
    int ok = is_ok(best->status), only_best = ok && !thorough && core->p.max_candidates == 1;
    relaxation level = ok ? RELAX_NONE : RELAX_ALL;
    double limit = ok ? CUTOFF * best->merit : INFINITY, bound[SCP_MOST_CANDIDATES];
    int order[SCP_MOST_CANDIDATES], done = 0;
    for (int k = 0; k < count; k++) {
        int i = k;
        looks[k].looked = looks[k].varied = 0;
        bound[k] = known[k] == NULL ? -INFINITY : bound_of(core, &looks[k], known[k], level);
        for (; i > 0 && bound[k] < bound[order[i - 1]]; i--)
            order[i] = order[i - 1];
        order[i] = k;
    }
    for (int i = 0; i < count && allows(core, TASK_CANDIDATE); i++, done++) {
        ranked *one = &looks[order[i]];
        double most = one->waits && ok ? PROMISING * best->merit : limit;
        if (bound[order[i]] > most) {
            keep_known(core, known[order[i]], one);
            one->looked = 1;
            one->wins = 0;
            one->merit = INFINITY;
            core->out.cut++;
            continue;
        }
        look(core, level, most, known[order[i]], one);
        if (only_best && !one->waits)
            limit = fmin(limit, one->merit);
    }
    return done;
}

/* ---- a search among polytopes */

static void copy_ranked(const scp_core *core, const ranked *from, ranked *to)
{
    const layout *at = &core->at;
    ranked kept = *to;
    *to = *from;
    to->path = kept.path;
    to->v = kept.v;
    to->force = kept.force;
    memcpy(to->path, from->path, (size_t)(at->nodes.size * at->d) * sizeof(double));
    memcpy(to->v, from->v, (size_t)at->nv * sizeof(double));
    memcpy(to->force, from->force, (size_t)(at->nf + at->most_pairs) * sizeof(double));
}

/* The best few of those that can be followed and differ in cost; how many, and which. */
static int best_few(int count, const ranked *const *of, const ranked **few)
{
    int found = 0;
    double last = -INFINITY;
    for (int used = 0; used < count && found < BEAM; used++) {
        const ranked *next = NULL;
        for (int i = 0; i < count; i++) /* the cheapest of those beyond the last one looked at */
            if (of[i]->looked && isfinite(of[i]->merit) && of[i]->merit > last &&
                (next == NULL || of[i]->merit < next->merit))
                next = of[i];
        if (next == NULL)
            break;
        last = next->merit;
        if (!found || next->merit - few[found - 1]->merit > ALIKE * next->merit)
            few[found++] = next;
    }
    return found;
}

/* The beam becomes the best few of itself and of others; how many. */
static int choose(scp_core *core, int beam, int count, const ranked *others)
{
    multi_room *room = core->multi;
    const ranked *all[BEAM + SCP_MOST_CANDIDATES], *few[BEAM];
    for (int i = 0; i < beam + count; i++)
        all[i] = i < beam ? &room->beam[i] : &others[i - beam];
    int found = best_few(beam + count, all, few);
    for (int i = 0; i < found; i++)
        copy_ranked(core, few[i], &room->next[i]);
    for (int i = 0; i < BEAM; i++) {
        ranked kept = room->beam[i];
        room->beam[i] = room->next[i];
        room->next[i] = kept;
    }
    return found;
}

/* Paths that pass one polytope at one stage by another face than a candidate of the beam does. */
static int vary(scp_core *core, int beam, int most)
{
    const layout *at = &core->at;
    multi_room *room = core->multi;
    int size = at->nodes.size * at->d, count = 0;
    size_t mark = core->scratch.used;
    double *path = doubles(&core->scratch, (size_t)(size + at->d));
    uint8_t *touched = bytes(&core->scratch, (size_t)at->most_pairs);
    for (int i = 0; i < beam && count < most; i++)
        if (!room->beam[i].varied) {
            passing(core, &room->beam[i], path, touched);
            count += varied(core, path + at->d, touched, most - count,
                            room->variations + count * size);
        }
    for (int i = 0; i < beam; i++)
        room->beam[i].varied = 1;
    for (int i = 0; i < count; i++) {
        room->more[i].waits = 0;
        memcpy(room->more[i].path, room->variations + i * size, (size_t)size * sizeof *path);
    }
    core->scratch.used = mark;
    return count;
}

/* Among polytopes, which face to pass at which stage is a search: the best few of all. Each is
 * varied by one face at one stage, as long as that finds better ones. Returns how many are in the
 * beam. */
static int search(scp_core *core, const result *best, int count, const ranked *base)
{
    multi_room *room = core->multi;
    const double *unknown[MOST_AMONG_WALLS] = {NULL};
    int beam = choose(core, 0, count, base);
    for (int i = 0; i < ROUNDS; i++) {
        int spare = 2 * core->p.max_iterations; /* to follow the best, and what comes then */
        int paths = vary(core, beam, MOST_AMONG_WALLS);
        int most = room_for(core, TASK_CANDIDATE, MOST_AMONG_WALLS, TASK_ITERATION, spare);
        if (!paths || !most)
            break;
        paths = paths < most ? paths : most;
        lap began = mark_time(core);
        int done = rank(core, best, 1, paths, room->more, unknown);
        learn_time(core, TASK_CANDIDATE, began, done);
        beam = choose(core, beam, paths, room->more);
    }
    return beam;
}

/* ---- what becomes of the best */

/* Those that were looked at, best first, those that wait last; ties keep their order. */
static int sorted(int count, ranked *looks, ranked **order)
{
    int found = 0;
    for (int k = 0; k < count; k++) {
        int i = found;
        if (!looks[k].looked)
            continue;
        for (; i > 0 && (looks[k].waits < order[i - 1]->waits ||
                         (looks[k].waits == order[i - 1]->waits &&
                          looks[k].merit < order[i - 1]->merit)); i--)
            order[i] = order[i - 1];
        order[i] = &looks[k];
        found++;
    }
    return found;
}

/* Follow a candidate to its end, which becomes the best plan if it is better by enough. */
static void challenge(scp_core *core, const ranked *one, int hard, result *best)
{
    multi_room *room = core->multi;
    if (!start_from(core, one))
        return;
    take_path(core, one->path);
    run_loop(core, &room->start, best, room->about.y, 0, hard, &room->end);
    if (!room->end.there || !beats(&room->end, best, HYSTERESIS * best->merit))
        return;
    result kept = *best;
    *best = room->end;
    room->end = kept;
    core->out.switched = 1;
}

/* A plan with slack is beaten by any without, and one that costs far more by others: then more
 * candidates are worth their time. */
static void follow(scp_core *core, int count, ranked *const *order, int most, int safe,
                   result *best)
{
    for (int k = 0; k < count && !core->broken; k++) {
        const ranked *one = order[k];
        int wanted = safe ? k < most : k < MOST_FOLLOWED && !is_ok(best->status);
        if (one->waits || (safe && !wanted && k < MOST_PROMISING))
            wanted = one->merit <= PROMISING * best->merit;
        if (!one->wins || !wanted || (core->linear && one->yields)) /* its first program has none */
            continue;
        if (!allows(core, TASK_ITERATION))
            break;
        if (!safe || !is_like(core, one)) /* else it leads to where we are */
            challenge(core, one, 1, best);
    }
    /* None is without slack; then the one that seems to need the least is worth a try. */
    if (count && !is_ok(best->status) && order[0]->wins && order[0]->merit < best->merit)
        challenge(core, order[0], 0, best);
}

static void note(scp_core *core, int count)
{
    multi_room *room = core->multi;
    scp_outputs *out = &core->out;
    for (int k = 0; k < count; k++)
        if (room->base[k].looked) {
            scp_candidate *to = &out->candidate[out->candidates++];
            to->obstacle = room->paths[k].obstacle;
            to->time = room->paths[k].time;
            to->merit = room->base[k].merit;
            memcpy(to->side, room->paths[k].side, sizeof to->side);
        } else {
            room->made.obstacle[k] = -1;
        }
}

/* Rank the candidates past the obstacles by one program each; follow the best of them. Among
 * polytopes the search is thorough where there is no plan from the step before, or where the one
 * that is there is not safe.
 *
 * best: the plan that is there, replaced if another one wins. free_path: (C, d) of the plan that
 * ignores the obstacles. has_last: whether there is a plan from the step before. */
void multi_start(scp_core *core, result *best, const double *free_path, int has_last)
{
    multi_room *room = core->multi;
    const double *known[SCP_MOST_CANDIDATES] = {NULL};
    ranked *order[SCP_MOST_CANDIDATES];
    int safe = is_ok(best->status), thorough = core->now->has_shapes && (!has_last || !safe);
    int most = thorough ? MOST_AMONG_WALLS : MOST;
    most = room_for(core, TASK_CANDIDATE, most, TASK_ITERATION, 0);
    room->made.count = 0;
    if (!most)
        return;
    lap began = mark_time(core);
    path_of(core, best->at.y, room->here_path);
    for (int k = 0; k < core->now->J * core->at.nodes.size; k++)
        room->here[k] = best->it.has_multipliers && best->it.obstacles[k] < -NEGLIGIBLE;
    int count = candidate_paths(core, free_path, room->here_path + core->at.d, most, room->paths);
    if (!count || !become_incumbent(core, best, free_path))
        return;
    for (int k = 0; k < count; k++) {
        int obstacle = room->paths[k].obstacle, number = 1;
        for (int i = 0; i < k; i++)
            number += room->paths[i].obstacle == obstacle;
        room->made.obstacle[k] = obstacle;
        room->made.number[k] = number;
        known[k] = has_last ? known_force(room, obstacle, number) : NULL;
        room->base[k].waits = room->paths[k].waits;
    }
    learn_time(core, TASK_CANDIDATE, began,
               rank(core, best, thorough, count, room->base, known));
    room->made.count = count;
    note(core, count);
    int follows = core->p.max_candidates + (thorough ? BEAM - 1 : 0); /* some lead here again */
    int beam = thorough ? search(core, best, count, room->base) : 0;
    int few = beam ? sorted(beam, room->beam, order) : sorted(count, room->base, order);
    follow(core, few, order, follows, safe, best);
}
