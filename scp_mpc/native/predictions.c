/* Predictions at the nodes of a plan, and which of them a path is near to; scp_mpc/scp/step.py.
 *
 * Notation:
 *     J       obstacles
 *     C       collision nodes, K n in each interval
 *
 * Covariances are decomposed where a half-space asks for it: most obstacles are far away, and two
 * bounds of the distance show that.
 */
#include "core.h"
#include "small.h"

static const double ROUNDING = 1e-9; /* of a covariance, relative to its largest entry */
static const double DOUBLE = -0.99;  /* in Cardano's formula: -1 where two eigenvalues are the same */
static const double TICK = 1e-9;
static const double TOUCH = 1e-9;    /* [m] that is no distance */
static const double SIGMAS = 3.0;    /* deviations that an obstacle's way may differ from its mean's by */
static const double IMPOSSIBLE = 40.0; /* standard deviations beyond which Phi is zero in floats */

/* ---- memory */

/* What scaling changes, if there is any. */
void lay_out_scaled(const scp_core *core, arena *from, nodes of, int scales, step_room *room)
{
    size_t M = (size_t)core->at.M, C = (size_t)of.size, d = (size_t)core->at.d;
    room->scaled = doubles(from, scales ? M * (C + 1) * d * d : 0);
    room->scaled_std = doubles(from, scales ? M * (C + 1) : 0);
    room->rotation = doubles(from, M * C * d * d);
    room->deviation = doubles(from, M * C * d);
    room->decomposed = bytes(from, M * C);
}

void lay_out_room(const scp_core *core, arena *from, nodes of, step_room *room)
{
    size_t M = (size_t)core->at.M, C = (size_t)of.size, d = (size_t)core->at.d;
    room->nodes = of;
    room->means = doubles(from, M * (C + 1) * d);
    room->covariances = doubles(from, M * (C + 1) * d * d);
    room->largest_std = doubles(from, M * (C + 1));
    room->drift = doubles(from, of.K > 1 ? M * C : 0);
    room->radii = doubles(from, M * C);
    lay_out_scaled(core, from, of, core->p.sizes || core->p.backup_sizes, room);
}

/* ---- covariances */

/* The largest eigenvalue; in space by Cardano's formula, which loses half of the digits where the two
 * largest are the same. */
static inline double largest_eigenvalue(const int d, const double *S)
{
    if (d == 2) {
        double half = (S[0] - S[3]) / 2;
        return (S[0] + S[3]) / 2 + sqrt(half * half + S[2] * S[2]);
    }
    double values[3] = {S[0], S[4], S[8]}, off = S[3] * S[3] + S[6] * S[6] + S[7] * S[7];
    if (!(off > 0))
        return greatest(3, values);
    double mean = (S[0] + S[4] + S[8]) / 3, a = S[0] - mean, b = S[4] - mean, c = S[8] - mean;
    double spread = sqrt((a * a + b * b + c * c + 2 * off) / 6);
    double det = a * (b * c - S[7] * S[7]) - S[3] * (S[3] * c - S[7] * S[6]) +
                 S[6] * (S[3] * S[7] - b * S[6]);
    double r = det / (2 * spread * spread * spread);
    if (r >= DOUBLE)
        return mean + 2 * spread * cos(acos(lesser(r, 1.0)) / 3);
    double vectors[9]; /* or no number: entries that are tiny */
    eigen_small(3, S, values, vectors);
    return values[2];
}

double largest_variance(int d, const double *Sigma)
{
    return d == 2 ? largest_eigenvalue(2, Sigma) : largest_eigenvalue(3, Sigma);
}

/* Whether no eigenvalue is below -allowed: pivots of Sigma + allowed I. */
static inline int is_semidefinite(const int d, const double *Sigma, double allowed)
{
    double A[9];
    for (int k = 0; k < d * d; k++)
        A[k] = Sigma[k] + (k % (d + 1) ? 0 : allowed);
    for (int k = 0; k < d; k++) {
        if (A[k * d + k] < 0)
            return 0;
        for (int i = k + 1; i < d; i++) {
            double share = A[k * d + k] > 0 ? A[i * d + k] / A[k * d + k] : 0;
            if (!(A[k * d + k] > 0) && A[i * d + k] != 0)
                return 0;
            for (int l = k + 1; l <= i; l++)
                A[i * d + l] -= share * A[l * d + k];
        }
    }
    return 1;
}

/* Whether matrices (count, d, d) are symmetric and positive semi-definite, up to rounding in a
 * product such as J Sigma J'; and the roots (count,) of their largest eigenvalues, if wanted. */
static inline int check_covariances(const int d, int count, const double *Sigma, double *stds)
{
    for (int i = 0; i < count; i++, Sigma += d * d) {
        double most = 0, asymmetry = 0;
        for (int k = 0; k < d; k++)
            for (int l = 0; l <= k; l++) {
                double one = Sigma[k * d + l], other = Sigma[l * d + k];
                most = larger(larger(fabs(one), fabs(other)), most);
                asymmetry = larger(fabs(one - other), asymmetry);
            }
        if (asymmetry > ROUNDING * most || !is_semidefinite(d, Sigma, ROUNDING * most))
            return 0;
        if (stds)
            stds[i] = sqrt(larger(largest_eigenvalue(d, Sigma), 0.0));
    }
    return 1;
}

int are_covariances(int d, int count, const double *Sigma, double *stds)
{
    return d == 2 ? check_covariances(2, count, Sigma, stds) : check_covariances(3, count, Sigma, stds);
}

/* ---- at the nodes */

/* The stage up to which covariances grow for the plan. */
static int last_grown(const scp_core *core, int N)
{
    double last = core->p.growth_time > 0 ? ceil(core->p.growth_time / core->p.dt - TICK) : N;
    return last < N ? (int)last : N;
}

/* Of the prediction of an obstacle whose rows begin at `first`: the row that counts at stage i. */
static inline int counting(const predictions *given, int first, int i, int last)
{
    const double *std = given->largest_std + first;
    return first + (i > last && std[i] > std[last] ? last : i);
}

/* Covariance at a sample, with the robot's; returns a bound of its variances. */
static inline double at_sample(const int d, const predictions *given, const double *robot, int row,
                               int i, double *Sigma)
{
    double std = given->largest_std[row], trace = 0;
    for (int k = 0; k < d * d; k++)
        Sigma[k] = given->covariances[row * d * d + k] + (robot ? robot[i * d * d + k] : 0);
    for (int k = 0; robot && k < d; k++)
        trace += robot[i * d * d + k * (d + 1)];
    return std * std + trace;
}

/* Values (width,) at the nodes of an interval, linear between its ends: for covariances this errs on
 * the safe side, if the obstacle moves in a straight line. Returns where those of the next begin. */
static inline double *interpolate(const int width, nodes of, const double *restrict before,
                                  const double *restrict after, double *restrict to)
{
    for (int k = 1; k <= of.K; k++) {
        double share = (double)k / of.K, rest = 1 - share;
        for (int disc = 0; disc < of.n; disc++, to += width)
            for (int l = 0; l < width; l++)
                to[l] = rest * before[l] + share * after[l];
    }
    return to;
}

static inline void spread_means(const int d, const predictions *given, nodes of, double *to)
{
    for (int j = 0; j < given->J; j++) {
        const double *row = given->means + j * (of.N + 1) * d;
        memcpy(to, row, (size_t)d * sizeof *to);
        to += d;
        for (int i = 0; i < of.N; i++, row += d)
            to = interpolate(d, of, row, row + d, to);
    }
}

static inline void spread_covariances(const int d, const predictions *given, nodes of,
                                      const double *robot, int last, double *to, double *std)
{
    for (int j = 0, first = 0; j < given->J; j++, first += of.N + 1, std += of.size + 1) {
        double ends[2][9], variances[2];
        double *root = std + 1;
        variances[0] = at_sample(d, given, robot, first, 0, ends[0]);
        std[0] = variances[0];
        memcpy(to, ends[0], (size_t)(d * d) * sizeof *to);
        to += d * d;
        for (int i = 0; i < of.N; i++) {
            int now = i % 2, then = 1 - now, row = counting(given, first, i + 1, last);
            variances[then] = at_sample(d, given, robot, row, i + 1, ends[then]);
            to = interpolate(d * d, of, ends[now], ends[then], to);
            root = interpolate(1, of, variances + now, variances + then, root);
        }
        for (int i = 0; i <= of.size; i++)
            std[i] = sqrt(std[i]);
    }
}

/* Way of the obstacles between two instants: that of the mean, and three standard deviations of
 * what the covariance grows by. */
static inline void spread_drift(const int d, const predictions *given, nodes of, int last,
                                double *drift)
{
    for (int j = 0, first = 0; j < given->J; j++, first += of.N + 1) {
        const double *mean = given->means + first * d;
        double std = given->largest_std[first];
        for (int i = 0; i < of.N; i++, mean += d) {
            double then = given->largest_std[counting(given, first, i + 1, last)], way[3];
            double grown = then * then - std * std;
            difference(d, mean + d, mean, way);
            double sum = sqrt(inner(d, way, way)) + (grown > 0 ? SIGMAS * sqrt(grown) : 0);
            for (int k = 0; k < of.count; k++)
                *drift++ = sum / of.K;
            std = then;
        }
    }
}

/* All that lies between the samples. */
static inline void spread(const int d, const predictions *given, const double *robot, int last,
                          const step_room *room, step *to)
{
    const nodes of = room->nodes;
    if (of.count > 1) {
        spread_means(d, given, of, room->means);
        to->means = room->means;
    }
    if (of.count > 1 || robot || last < of.N) {
        spread_covariances(d, given, of, robot, last, room->covariances, room->largest_std);
        to->bare = room->covariances;
        to->bare_std = room->largest_std;
    }
    if (of.K > 1) {
        spread_drift(d, given, of, last, room->drift);
        to->drift = room->drift;
    }
}

/* Covariances and deviations of nodes 1 .. C times sizes (J, C), or one for all. */
void scale_covariances(int d, const double *sizes, double scale, nodes of, step_room *room, step *to)
{
    const int C = of.size;
    for (int j = 0; j < to->J; j++)
        for (int i = 0; i <= C; i++) {
            int here = j * (C + 1) + i;
            double by = i == 0 ? 1 : sizes ? scale * sizes[j * C + i - 1] : scale;
            for (int k = 0; k < d * d; k++)
                room->scaled[here * d * d + k] = by * by * to->bare[here * d * d + k];
            room->scaled_std[here] = by * to->bare_std[here];
        }
    to->covariances = room->scaled;
    to->largest_std = room->scaled_std;
}

void predict(const scp_core *core, const predictions *given, const double *robot_covariance,
             double scale, step_room *room, step *to)
{
    const int J = given->J, last = last_grown(core, room->nodes.N);
    const nodes of = room->nodes;
    memset(to, 0, sizeof *to);
    to->J = J;
    to->nodes = of;
    to->shape = given->shape;
    to->means = given->means;
    to->bare = given->covariances;
    to->bare_std = given->largest_std;
    if (core->at.d == 2)
        spread(2, given, robot_covariance, last, room, to);
    else
        spread(3, given, robot_covariance, last, room, to);
    to->covariances = to->bare;
    to->largest_std = to->bare_std;
    if (scale != 1)
        scale_covariances(core->at.d, NULL, scale, of, room, to);
    for (int j = 0; j < J; j++) {
        to->has_shapes |= given->shape[j] >= 0;
        for (int i = 0; i < of.size; i++)
            room->radii[j * of.size + i] = core->p.robot_radius + given->radii[j];
    }
    to->radii = room->radii;
    to->rotation = room->rotation;
    to->deviation = room->deviation;
    to->decomposed = room->decomposed;
    memset(room->decomposed, 0, (size_t)(J * of.size));
}

/* ---- which obstacles are near */

/* `within` for one obstacle that is round. The direction n from the mean to p gives a lower bound of
 * the signed distance to the s-sigma ellipsoid, n'(p - mu) - s sqrt(n' Sigma n), and n' Sigma n is at
 * most the largest variance. Who is clear by these bounds is clear of either inflation's no-go set.
 * Returns 0 if nobody is near. */
static inline int near_ball(const int d, const step *at, int j, const double *restrict path, double s,
                            double distance, uint8_t *restrict near)
{
    const int C = at->nodes.size, first = j * (C + 1) + 1;
    const double *restrict means = at->means + first * d, *restrict std = at->largest_std + first;
    const double *restrict radii = at->radii + j * C;
    int some = 0;
    for (int i = 0; i < C; i++) {
        double length2 = 0, least = s * std[i] + (radii[i] + distance);
        for (int l = 0; l < d; l++) {
            double y = path[i * d + l] - means[i * d + l];
            length2 += y * y;
        }
        int unclear = length2 <= least * least;
        near[i] = (uint8_t)unclear;
        some |= unclear;
    }
    for (int i = 0; some && i < C; i++) {
        if (!near[i])
            continue;
        double y[3], wide[3];
        difference(d, path + i * d, means + i * d, y);
        times(d, d, 1, at->covariances + (first + i) * d * d, y, wide);
        double length2 = inner(d, y, y), width2 = larger(inner(d, wide, y), 0.0);
        near[i] = length2 - s * sqrt(width2) <= (radii[i] + distance) * sqrt(length2);
    }
    return some;
}

/* Polytopes are measured with the distance itself, unless their farthest corner is far away. */
static int near_solid(int d, const solid *body, const step *at, int j, const double *path, double s,
                      double distance, uint8_t *near)
{
    const int C = at->nodes.size, first = j * (C + 1) + 1;
    int some = 0;
    for (int i = 0; i < C; i++) {
        double y[3] = {0}, reach = s * at->largest_std[first + i] + distance, r = at->radii[j * C + i];
        difference(d, path + i * d, at->means + (first + i) * d, y);
        near[i] = sqrt(inner(d, y, y)) - body->size <= reach + r + TOUCH &&
                  solid_distance(d, body, y, NULL, NULL, NULL) - r <= reach;
        some |= near[i];
    }
    return some;
}

/* `path` (C, d) of nodes 1 .. C. */
static int near_nodes(const scp_core *core, const step *at, const double *path, const double *s,
                      double distance, const uint8_t *known, uint8_t *near)
{
    const int C = at->nodes.size, d = core->at.d;
    int count = 0;
    for (int j = 0; j < at->J; j++, near += C) {
        const solid *body = at->shape[j] < 0 ? NULL : core->solids + at->shape[j];
        int some = body ? near_solid(d, body, at, j, path, s[j], distance, near)
                   : d == 2 ? near_ball(2, at, j, path, s[j], distance, near)
                            : near_ball(3, at, j, path, s[j], distance, near);
        for (int i = 0; some && i < C; i++) {
            near[i] = near[i] && !(known && known[j * C + i]);
            count += near[i];
        }
    }
    return count;
}

int within(const scp_core *core, const step *at, const double *path, const double *s,
           double distance, const uint8_t *known, uint8_t *near)
{
    return near_nodes(core, at, path + core->at.d, s, distance, known, near);
}

void depths(scp_core *core, const step *at, const double *path, const double *s, double *deep)
{
    const int C = at->nodes.size, d = core->at.d;
    size_t mark = core->scratch.used;
    uint8_t *near = bytes(&core->scratch, (size_t)(at->J * C));
    int some = near_nodes(core, at, path, s, 0.0, NULL, near);
    for (int k = 0; k < at->J * C; k++)
        deep[k] = 0;
    for (int k = 0; some && k < at->J * C; k++) {
        if (!near[k])
            continue;
        double now[3], before[3], a[4], bend[6];
        no_go set;
        int j = k / C, i = k % C;
        for (int l = 0; l < d; l++)
            now[l] = at->x0[core->p.position[l]];
        difference(d, i ? path + (i - 1) * d : now, at->means + (j * (C + 1) + i) * d, before);
        no_go_of(core, at, j, i, &set);
        deep[k] = larger(-linearise_no_go(core, &set, path + i * d, s[j], before, a, bend), 0.0);
    }
    core->scratch.used = mark;
}

void path_of(const scp_core *core, const double *y, double *path)
{
    const int C = core->at.nodes.size, d = core->at.d;
    for (int l = 0; l < d; l++) {
        double here = core->plain.x0[core->p.position[l]];
        path[l] = here;
        for (int i = 0; i < C; i++)
            path[(i + 1) * d + l] = y[core->at.p + i * d + l] + here;
    }
}

/* A risk is that of the whole prediction, whatever its size. */
void step_risks(const scp_core *core, const step *at, const double *path, double *risks)
{
    const int C = at->nodes.size, d = core->at.d;
    for (int k = 0; k < at->J * C; k++) {
        int j = k / C, i = k % C, here = j * (C + 1) + i + 1;
        const solid *body = at->shape[j] < 0 ? NULL : core->solids + at->shape[j];
        double y[3] = {0}, rotation[9], deviation[3];
        const double *p = path + i * d, *mean = at->means + here * d;
        difference(d, p, mean, y);
        double gap = sqrt(inner(d, y, y)) - at->radii[k] - (body ? body->size : 0);
        risks[k] = 0;
        if (gap > IMPOSSIBLE * at->bare_std[here] + TOUCH)
            continue;
        eigen_small(d, at->bare + here * d * d, deviation, rotation);
        for (int l = 0; l < d; l++)
            deviation[l] = sqrt(larger(deviation[l], 0.0));
        no_go set = {mean, rotation, deviation, at->radii[k], body};
        risks[k] = risk_of(core, &set, p);
    }
}
