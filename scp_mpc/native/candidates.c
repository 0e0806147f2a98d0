/* Paths that pass an obstacle on its other sides, or one stage earlier or later:
 * scp_mpc/scp/candidates.py, which says why. A candidate is a path that need not obey the dynamics:
 * the plan that ignores the obstacles, moved out of the way during one conflict, and the present
 * plan during the others.
 *
 * Notation:
 *     C       collision nodes of the plan; `count` of them in a stage
 *     free    (C, d)  positions of the plan that ignores the obstacles
 *     v       (d,)    motion relative to the obstacle in one stage, over the conflict [m]
 *     side    (d,)    unit vector square to v
 *     w, m    offset from an ellipsoid and side, in units of the semi-axes s sigma + r
 *     rho     s sigma + r, by which polytopes are rounded, or their faces put forward [m]
 */
#include "core.h"
#include "small.h"

enum { AROUND = 3 };       /* stages before and after a conflict that a candidate may change */
enum { MIXED = 3 };        /* polytopes whose sides are tried in all combinations */
enum { MOST_SIDES = 4 };   /* directions square to v */
static const double NO_RELATIVE_MOTION = 1e-6; /* in one stage, over the distance */
static const double COSINE = 0.9;    /* of the angle between two directions that count as one */
static const double TOUCH = 1e-9;    /* [m] less than that within is not within */
static const double PARALLEL = 1e-9; /* cosine below which a face is never reached */
static const double POINT = 1e-9;    /* [m] */
static const double MIDDLE = 1e-12;  /* in semi-axes */

/* Whether to leave away from the middle, and stages by which to pass earlier. */
static const struct {
    int outward;
    double time;
} VARIANTS[] = {{0, 0.0}, {0, -1.0}, {0, 1.0}, {1, -2.0}};

/* What is looked for, and what was found. */
typedef struct {
    const scp_core *core;
    const step *at;
    int C, d, count;
    const double *free_path;
    const uint8_t *conflict; /* (J, C) */
    int most, found;
    candidate_path *to;
} search;

/* The conflict of a row: from the first point on, gaps up to `around` do not end it. */
typedef struct {
    int first, last;
} span;

size_t scratch_of_candidates(const scp_core *core)
{
    const size_t M = (size_t)core->at.M, C = (size_t)core->at.nodes.size, d = (size_t)core->at.d;
    const size_t numbers = M * C + M + C * d + M * d, whole = 2 * M + (size_t)core->p.max_faces;
    return numbers * sizeof(double) + whole * sizeof(int) + M * C + 8 * 64;
}

static span run_of(const uint8_t *conflict, int C, int around)
{
    span run = {C, C};
    for (int i = 0; i < C; i++) {
        if (!conflict[i])
            continue;
        if (run.first == C)
            run.first = i;
        else if (i - run.last > around)
            break;
        run.last = i;
    }
    return run;
}

static double rho_of(const scp_core *core, const no_go *set)
{
    return set->radius + core->p.s_ref * greatest(core->at.d, set->deviation);
}

/* ---- directions */

/* Rows 1 .. d-1 of the reflection that takes v onto the first axis, as LAPACK's dlarfg has it:
 * numpy.linalg.svd(v[None])[2][1:]. The order of candidates hangs on their signs. */
static void square_to(int d, const double *v, double square[2][3])
{
    double rest = 0.0, reflector[3] = {1.0, 0.0, 0.0}, tau = 0.0;
    for (int l = 1; l < d; l++)
        rest += v[l] * v[l];
    if (rest > 0) {
        const double beta = -copysign(sqrt(v[0] * v[0] + rest), v[0]);
        tau = (beta - v[0]) / beta;
        for (int l = 1; l < d; l++)
            reflector[l] = v[l] / (v[0] - beta);
    }
    for (int k = 1; k < d; k++)
        for (int l = 0; l < d; l++)
            square[k - 1][l] = (k == l) - tau * reflector[k] * reflector[l];
}

/* Motion relative to obstacle j over a conflict, and directions square to it; how many. */
static int directions(const search *of, int j, span points, double *v, double sides[MOST_SIDES][3])
{
    const int d = of->d, begin = points.first > of->count ? points.first - of->count : 0;
    const int after = points.last + of->count, end = after < of->C - 1 ? after : of->C - 1;
    const double *mean = of->at->means + (j * (of->C + 1) + 1) * d;
    const double share = (double)of->count / (end - begin > 1 ? end - begin : 1);
    double start[3], stop[3], square[2][3];
    difference(d, of->free_path + begin * d, mean + begin * d, start);
    difference(d, of->free_path + end * d, mean + end * d, stop);
    for (int l = 0; l < d; l++)
        v[l] = (stop[l] - start[l]) * share;
    if (sqrt(inner(d, v, v)) <= NO_RELATIVE_MOTION * sqrt(inner(d, start, start))) {
        double size = 0.0;
        for (int l = 0; l < d; l++)
            size += fabs(start[l]);
        for (int l = 0; l < d; l++)
            v[l] = size > 0 ? start[l] : l == 0;
    }
    square_to(d, v, square);
    for (int k = 0; k < 2 * (d - 1); k++)
        for (int l = 0; l < d; l++)
            sides[k][l] = k % 2 ? -square[k / 2][l] : square[k / 2][l];
    return 2 * (d - 1);
}

/* ---- out of the no-go sets, point by point */

/* Out of an ellipsoid to its boundary, along the side. */
static void leave_aside(int d, const double *w, const double *m, const double *side, double *p)
{
    const double mm = inner(d, m, m), wm = inner(d, w, m), room = 1.0 - inner(d, w, w);
    const double shift = (sqrt(wm * wm + mm * room) - wm) / mm;
    for (int l = 0; l < d; l++)
        p[l] += shift * side[l];
}

/* Away from its middle, and half as much towards the side. */
static void leave_outward(int d, const no_go *set, const double *e, const double *m, double *w,
                          double *p)
{
    const double length = sqrt(inner(d, m, m));
    for (int l = 0; l < d; l++)
        w[l] += 0.5 * m[l] / length;
    const double far = larger(sqrt(inner(d, w, w)), MIDDLE);
    for (int l = 0; l < d; l++)
        w[l] *= e[l] / far;
    to_world(d, set->rotation, w, p);
    for (int l = 0; l < d; l++)
        p[l] += set->mean[l];
}

static void leave_ellipsoid(const scp_core *core, const no_go *set, int outward,
                            const double *side, double *p)
{
    const int d = core->at.d;
    double offset[3], w[3] = {0}, m[3], e[3];
    difference(d, p, set->mean, offset);
    to_eigenframe(d, set->rotation, offset, w);
    to_eigenframe(d, set->rotation, side, m);
    for (int l = 0; l < d; l++) {
        e[l] = larger(core->p.s_ref * set->deviation[l] + set->radius, POINT);
        w[l] /= e[l];
        m[l] /= e[l];
    }
    if (!(inner(d, w, w) < 1.0))
        return;
    if (outward)
        leave_outward(d, set, e, m, w, p);
    else
        leave_aside(d, w, m, side, p);
}

/* How far along a direction the faces of a polytope are that are put forward by rho. */
static double way_out(int d, const solid *body, double rho, const double *y, const double *along)
{
    double way = INFINITY;
    for (int f = 0; f < body->faces; f++) {
        const double *n = body->normal + f * d, speed = inner(d, along, n);
        if (speed > PARALLEL)
            way = lesser((rho - (inner(d, n, y) - body->offset[f])) / speed, way);
    }
    return way;
}

/* Out of one of several polytopes, and of what comes next, each along a direction of its own:
 * those of wall k begin at along + k * stride. */
static void leave_walls(const scp_core *core, const step *at, int count, const int *walls, int node,
                        const double *along, int stride, double *p)
{
    const int d = core->at.d;
    for (int pass = 0; pass < count; pass++) {
        const double *farthest = NULL;
        double most = 0.0, y[3];
        for (int k = 0; k < count; k++) {
            no_go set;
            no_go_of(core, at, walls[k], node, &set);
            const double rho = rho_of(core, &set), *direction = along + k * stride;
            difference(d, p, set.mean, y);
            if (!(solid_distance(d, set.body, y, NULL, NULL, NULL) < rho - TOUCH))
                continue;
            const double way = way_out(d, set.body, rho, y, direction);
            if (!farthest || way > most) {
                most = way;
                farthest = direction;
            }
        }
        if (!farthest)
            return;
        for (int l = 0; l < d; l++)
            p[l] += most * farthest[l];
    }
}

/* Out of one obstacle: away from it and half as much towards the side, or along the side. */
static void leave(const search *of, int j, int node, int outward, const double *side, double *p)
{
    const int d = of->d;
    no_go set;
    no_go_of(of->core, of->at, j, node, &set);
    if (!set.body) {
        leave_ellipsoid(of->core, &set, outward, side, p);
        return;
    }
    if (!outward) {
        leave_walls(of->core, of->at, 1, &j, node, side, 0, p);
        return;
    }
    double away[3], y[3];
    difference(d, p, set.mean, y);
    solid_distance(d, set.body, y, NULL, away, NULL);
    for (int l = 0; l < d; l++)
        away[l] += 0.5 * side[l];
    const double length = sqrt(inner(d, away, away));
    for (int l = 0; l < d; l++)
        away[l] /= length;
    leave_walls(of->core, of->at, 1, &j, node, away, 0, p);
}

/* ---- candidates */

static double *add(search *of, int obstacle, const double *side, double time, const double *path)
{
    candidate_path *one = of->to + of->found++;
    one->obstacle = obstacle;
    one->waits = 0;
    one->time = time;
    memcpy(one->side, side, (size_t)of->d * sizeof *side);
    memcpy(one->path, path, (size_t)(of->C * of->d) * sizeof *path);
    return one->path;
}

/* Stay where the free plan comes into conflict, in front of the obstacle. */
static void wait_before(search *of, int j)
{
    const int d = of->d;
    const span points = run_of(of->conflict + j * of->C, of->C, of->C);
    double v[3], sides[MOST_SIDES][3];
    directions(of, j, points, v, sides);
    const double length = sqrt(inner(d, v, v));
    for (int l = 0; l < d; l++)
        v[l] = -v[l] / length;
    double *path = add(of, j, v, 0.0, of->free_path);
    of->to[of->found - 1].waits = 1;
    for (int i = points.first; i < of->C; i++)
        for (int l = 0; l < d; l++)
            path[i * d + l] = points.first ? of->free_path[(points.first - 1) * d + l]
                                           : of->core->in.x0[of->core->p.position[l]];
}

/* Pass the polytopes in conflict, each on either side; `walls` has those first that come first. */
static void pass_together(search *of, int count, const int *walls, double *along)
{
    const int d = of->d, C = of->C, mixed = count < MIXED ? count : MIXED;
    span points = {C, 0};
    double v[3], sides[MOST_SIDES][3];
    for (int k = 0; k < count; k++)
        for (int i = 0; i < C; i++)
            if (of->conflict[walls[k] * C + i]) {
                points.first = i < points.first ? i : points.first;
                points.last = i > points.last ? i : points.last;
            }
    if (points.first == C || count < 2)
        return;
    const int ways = directions(of, walls[0], points, v, sides);
    for (int k = 0; k < ways && of->found < of->most; k++) {
        double *path = add(of, walls[0], sides[k], 0.0, of->free_path);
        for (int i = 0; i < C; i++)
            leave_walls(of->core, of->at, count, walls, i, sides[k], 0, path + i * d);
    }
    for (int bits = 1; bits < (1 << mixed) - 1 && of->found < of->most; bits++) {
        for (int k = 0; k < count; k++) { /* those beyond the first few go with the last of them */
            const int place = k < mixed ? mixed - 1 - k : 0;
            memcpy(along + k * d, sides[bits >> place & 1], (size_t)d * sizeof *along);
        }
        double *path = add(of, walls[0], along, 0.0, of->free_path);
        for (int i = 0; i < C; i++)
            leave_walls(of->core, of->at, count, walls, i, along, d, path + i * d);
    }
}

/* The free plan, and the present one during all conflicts but the first with obstacle j. */
static void elsewhere(const search *of, const double *present, int j, span run, double *path)
{
    const int C = of->C, d = of->d, around = AROUND * of->count;
    memcpy(path, of->free_path, (size_t)(C * d) * sizeof *path);
    for (int i = 0; i < C; i++) {
        int other = 0;
        for (int k = 0; k < of->at->J; k++)
            other |= of->conflict[k * C + i] && (k != j || i > run.last);
        if (!other)
            continue;
        const int begin = i > around ? i - around : 0, end = i + around < C ? i + around + 1 : C;
        memcpy(path + begin * d, present + begin * d, (size_t)((end - begin) * d) * sizeof *path);
    }
}

/* Through the surroundings of a conflict, put off or brought forward, and out of obstacle j. */
static void pass(search *of, int j, span reach, int outward, const double *side, double time,
                 const double *v, const double *path)
{
    const int d = of->d;
    double *moved = add(of, j, side, time, path);
    for (int i = reach.first; i <= reach.last; i++) {
        for (int l = 0; l < d; l++)
            moved[i * d + l] = of->free_path[i * d + l] + time * v[l];
        leave(of, j, i, outward, side, moved + i * d);
    }
}

/* Over faces of a polytope that look in other directions than these, and each other: at most two an
 * axis. */
static void pass_over_faces(search *of, int j, span reach, int ways, double sides[MOST_SIDES][3],
                            const double *path)
{
    const int d = of->d, began = of->found;
    const double none[3] = {0};
    const solid *body = of->core->solids + of->at->shape[j];
    for (int f = 0; f < body->faces && of->found - began < 2 * d && of->found < of->most; f++) {
        const double *n = body->normal + f * d;
        int known = 0;
        for (int k = 0; k < ways; k++)
            known |= !(inner(d, n, sides[k]) < COSINE);
        for (int k = began; k < of->found; k++)
            known |= !(inner(d, n, of->to[k].side) < COSINE);
        if (!known)
            pass(of, j, reach, 0, n, 0.0, none, path);
    }
}

static void paths_past(search *of, int j, const double *present, double *path)
{
    const int around = AROUND * of->count;
    const span run = run_of(of->conflict + j * of->C, of->C, around);
    const span reach = {run.first > around ? run.first - around : 0,
                        run.last + around < of->C ? run.last + around : of->C - 1};
    double v[3], sides[MOST_SIDES][3];
    const int ways = directions(of, j, run, v, sides);
    elsewhere(of, present, j, run, path);
    if (of->at->has_shapes && of->at->shape[j] >= 0)
        pass_over_faces(of, j, reach, ways, sides, path);
    for (size_t k = 0; k < sizeof VARIANTS / sizeof *VARIANTS; k++)
        for (int side = 0; side < ways && of->found < of->most; side++)
            pass(of, j, reach, VARIANTS[k].outward, sides[side], VARIANTS[k].time, v, path);
}

/* Insert j into obstacles ordered by when their conflicts begin; ties keep their order. */
static void insert(const search *of, int j, int count, int *order)
{
    const int first = run_of(of->conflict + j * of->C, of->C, 0).first;
    int k = count;
    for (; k > 0 && run_of(of->conflict + order[k - 1] * of->C, of->C, 0).first > first; k--)
        order[k] = order[k - 1];
    order[k] = j;
}

int candidate_paths(scp_core *core, const double *free_path, const double *present, int most,
                    candidate_path *to)
{
    const step *at = core->now;
    const int C = at->nodes.size, d = core->at.d, J = at->J;
    const size_t mark = core->scratch.used;
    double *s = doubles(&core->scratch, (size_t)core->at.M);
    double *deep = doubles(&core->scratch, (size_t)(J * C));
    double *path = doubles(&core->scratch, (size_t)(C * d));
    double *along = doubles(&core->scratch, (size_t)(J * d));
    uint8_t *conflict = bytes(&core->scratch, (size_t)(J * C));
    int *order = ints(&core->scratch, (size_t)J), *walls = ints(&core->scratch, (size_t)J);
    search of = {core, at, C, d, at->nodes.count, free_path, conflict, most, 0, to};
    int count = 0, shapes = 0;
    for (int j = 0; j < core->at.M; j++)
        s[j] = core->p.s_ref;
    depths(core, at, free_path, s, deep);
    for (int k = 0; k < J * C; k++)
        conflict[k] = deep[k] > 0;
    for (int j = 0; j < J; j++) {
        if (run_of(conflict + j * C, C, 0).first < C)
            insert(&of, j, count++, order);
        if (at->has_shapes && at->shape[j] >= 0)
            insert(&of, j, shapes++, walls);
    }
    pass_together(&of, shapes, walls, along);
    for (int k = 0; k < count && of.found < most; k++)
        paths_past(&of, order[k], present, path);
    if (count)
        wait_before(&of, order[0]);
    core->scratch.used = mark;
    return of.found;
}

/* ---- variations of a path, and whether two are one */

static int any(const uint8_t *values, int count)
{
    int found = 0;
    for (int i = 0; i < count; i++)
        found |= values[i];
    return found;
}

/* numpy.unique of the faces' normals: their order and, of equal ones, the first; how many. */
static int sorted_faces(int d, const solid *body, int *order)
{
    int count = 0;
    for (int f = 0; f < body->faces; f++) {
        const double *n = body->normal + f * d;
        int place = 0, same = 0;
        for (; place < count && !same; place++) {
            const double *other = body->normal + order[place] * d;
            int l = 0;
            while (l < d - 1 && n[l] == other[l])
                l++;
            same = n[l] == other[l];
            if (n[l] < other[l])
                break;
        }
        if (same)
            continue;
        memmove(order + place + 1, order + place, (size_t)(count - place) * sizeof *order);
        order[place] = f;
        count++;
    }
    return count;
}

/* Paths that pass one polytope at one stage by another face than a path does. What does not push
 * the path need not be moved: to give it more room would gain nothing. */
int varied(scp_core *core, const double *path, const uint8_t *touched, int most, double *to)
{
    const step *at = core->now;
    const int C = at->nodes.size, d = core->at.d, count = at->nodes.count;
    const size_t mark = core->scratch.used;
    int *order = ints(&core->scratch, (size_t)core->p.max_faces), found = 0;
    for (int j = 0; j < at->J; j++)
        for (int begin = 0; at->shape[j] >= 0 && begin < C; begin += count) {
            if (!any(touched + j * C + begin, count))
                continue;
            double y[3], here[3], over[3];
            no_go set;
            no_go_of(core, at, j, begin + count - 1, &set);
            const int faces = sorted_faces(d, set.body, order);
            difference(d, path + (begin + count - 1) * d, set.mean, y);
            solid_distance(d, set.body, y, NULL, here, NULL);
            for (int k = 0; k < faces && found < most; k++) {
                const double *n = set.body->normal + order[k] * d;
                if (!(inner(d, n, here) < COSINE))
                    continue;
                double *moved = to + found++ * C * d;
                memcpy(moved, path, (size_t)(C * d) * sizeof *path);
                for (int i = begin; i < begin + count; i++) {
                    no_go_of(core, at, j, i, &set);
                    difference(d, path + i * d, set.mean, y);
                    solid_over(d, set.body, order[k], y, over);
                    for (int l = 0; l < d; l++)
                        moved[i * d + l] = set.mean[l] + over[l] + rho_of(core, &set) * n[l];
                }
            }
        }
    core->scratch.used = mark;
    return found;
}

/* Direction in which a point lies from its obstacle: of polytopes, the normal. */
static void outward_of(const scp_core *core, int j, int node, const double *p, double *y)
{
    const step *at = core->now;
    const int d = core->at.d;
    difference(d, p, at->means + (j * (at->nodes.size + 1) + node + 1) * d, y);
    if (at->has_shapes && at->shape[j] >= 0) {
        const double offset[3] = {y[0], y[1], d > 2 ? y[2] : 0.0};
        solid_distance(d, core->solids + at->shape[j], offset, NULL, y, NULL);
    }
}

/* Whether two plans are pushed by the same obstacles at the same stages on the same side. */
int same_pattern(const scp_core *core, const double *path_a, const uint8_t *touched_a,
                 const double *path_b, const uint8_t *touched_b)
{
    const step *at = core->now;
    const int C = at->nodes.size, d = core->at.d, count = at->nodes.count;
    for (int j = 0; j < at->J; j++)
        for (int begin = 0; begin < C; begin += count) {
            const int sample = begin + count - 1, mine = any(touched_a + j * C + begin, count);
            double a[3], b[3];
            if (mine != any(touched_b + j * C + begin, count))
                return 0;
            if (!mine)
                continue;
            outward_of(core, j, sample, path_a + sample * d, a);
            outward_of(core, j, sample, path_b + sample * d, b);
            if (inner(d, a, b) < COSINE * sqrt(inner(d, a, a) * inner(d, b, b)))
                return 0;
        }
    return 1;
}
