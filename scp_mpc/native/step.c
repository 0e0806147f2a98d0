/* What one control step brings, checked before anything is computed; scp_mpc/scp/step.py, and the
 * bounds of layout.py.
 *
 * Notation:
 *     J, M    obstacles of this step, slots for them
 *     C       collision nodes, K n in each interval
 *     E       rows of bounded states and of speed
 *
 * Covariances are decomposed where a half-space asks for it: most obstacles are far away, and two
 * bounds of the distance show that.
 */
#include "core.h"
#include "small.h"

static const double LARGEST = 1e15;  /* of any number */
static const double ROUNDING = 1e-9; /* of a covariance, relative to its largest entry */
static const double UNIT = 1e-6;     /* by which the length of a normal may differ from one */
static const double TICK = 1e-9;
static const double TOUCH = 1e-9;    /* [m] within another body that is not */
static const double OUTSIDE = 1e-9;  /* of a bound, in its own unit, that is not */
static const double SIGMAS = 3.0;    /* deviations that an obstacle's way may differ from its mean's by */
static const double NONE = 1e30;     /* bounds that are none */
static const double HARD = 10.0;     /* price of a hard state's excess in merits, times that of slack */
static const double IMPOSSIBLE = 40.0; /* standard deviations beyond which Phi is zero in floats */
static const double DOUBLE = -0.99;    /* in Cardano's formula: -1 where two eigenvalues are the same */
static const double TURN = 6.283185307179586;

typedef struct {
    step_room room, scaled;  /* the second is that of the scaled step */
    double *wide_radii;      /* (M, C) */
    double *stds;            /* (M, N+1) largest standard deviations of the predictions */
    double *begin, *along;   /* (max_shapes, max_edges, d) of edges; zeros for corners */
    double *outside, *braked; /* (2, ny) lower and upper bounds */
    int has_braked;
} memory;

/* ---- memory */

/* What scaling changes, if there is any. */
static void lay_out_scaled(const scp_core *core, arena *from, nodes of, int scales, step_room *room)
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

void lay_out_step(scp_core *core, arena *from)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    size_t M = (size_t)at->M, N = (size_t)at->N, C = (size_t)at->nodes.size, ny = (size_t)at->ny;
    size_t d = (size_t)at->d, shapes = (size_t)p->max_shapes;
    memory *my = take(from, 1, sizeof *my), none;
    core->steps = my;
    if (!my)
        my = &none;
    lay_out_room(core, from, at->nodes, &my->room);
    if (p->joint_risk > 0)
        lay_out_scaled(core, from, at->nodes, 1, &my->scaled);
    my->wide_radii = doubles(from, M * C);
    my->stds = doubles(from, M * (N + 1));
    my->begin = doubles(from, shapes * (size_t)p->max_edges * d);
    my->along = doubles(from, shapes * (size_t)(p->max_edges + p->max_corners) * d);
    my->outside = doubles(from, at->nb ? 2 * ny : 0);
    my->braked = doubles(from, at->nb ? 2 * ny : 0);
    core->x_ref = doubles(from, (N + 1) * (size_t)at->nx);
    core->solids = take(from, shapes, sizeof(solid));
    core->lower = doubles(from, ny);
    core->upper = doubles(from, ny);
    core->braking_u = doubles(from, N * (size_t)at->nu);
    core->braking_x = doubles(from, (N + 1) * (size_t)at->nx);
    core->row_price = doubles(from, N * (size_t)at->nb);
}

size_t scratch_of_step(const scp_core *core)
{
    const layout *at = &core->at;
    int longest = backup_horizon(core) * at->nodes.count;
    return (size_t)(at->M * longest) + (size_t)(at->nodes.n * at->d) * sizeof(double) + 128;
}

/* ---- checks */

/* A positive double that is larger, infinite or no number has the larger bits: integers are
 * compared, since sums and maxima of doubles in a given order are slow. */
static int are_numbers(int count, const double *x)
{
    const uint64_t unsigned_part = ~(uint64_t)0 >> 1;
    uint64_t most, wrong = 0;
    memcpy(&most, &LARGEST, sizeof most);
    for (int i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, x + i, sizeof bits);
        wrong |= most - (bits & unsigned_part);
    }
    return !(wrong >> 63);
}

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
static inline int are_covariances(const int d, int count, const double *Sigma, double *stds)
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

static int covariances_hold(int d, int count, const double *Sigma, double *stds)
{
    return are_numbers(count * d * d, Sigma) &&
           (d == 2 ? are_covariances(2, count, Sigma, stds) : are_covariances(3, count, Sigma, stds));
}

/* Inputs by number, in the order of their struct. */
enum {
    IN_X0 = 1, IN_X_REF, IN_U_LAST, IN_HAS_U_LAST, IN_COUNT, IN_MEANS, IN_COVARIANCES, IN_RADII,
    IN_SHAPE, IN_SHAPES, IN_CORNERS, IN_FACES, IN_EDGES, IN_CORNER, IN_NORMAL, IN_OFFSET, IN_EDGE,
    IN_ROBOT_COVARIANCE
};

const char *scp_input_name(int number)
{
    static const char *const names[] = {
        "", "x0", "x_ref", "u_last", "has_u_last", "count", "means", "covariances", "radii",
        "shape", "shapes", "corners", "faces", "edges", "corner", "normal", "offset", "edge",
        "robot_covariance"};
    return number > 0 && number <= IN_ROBOT_COVARIANCE ? names[number] : "";
}

static int is_between(int n, int least, int most) { return n >= least && n <= most; }

static int wrong_shape(const scp_core *core, int k)
{
    const scp_problem *p = &core->p;
    const scp_inputs *in = &core->in;
    const int d = p->dim, corners = in->corners[k], faces = in->faces[k];
    const int *edge = in->edge + 2 * k * p->max_edges;
    const double *normal = in->normal + k * p->max_faces * d;
    if (!is_between(corners, d + 1, p->max_corners))
        return IN_CORNERS;
    if (!is_between(faces, d + 1, p->max_faces))
        return IN_FACES;
    if (d == 3 && !is_between(in->edges[k], 6, p->max_edges))
        return IN_EDGES;
    if (!are_numbers(corners * d, in->corner + k * p->max_corners * d))
        return IN_CORNER;
    for (int f = 0; f < faces; f++)
        if (!(fabs(inner(d, normal + f * d, normal + f * d) - 1) <= UNIT))
            return IN_NORMAL;
    if (!are_numbers(faces, in->offset + k * p->max_faces))
        return IN_OFFSET;
    for (int e = 0; d == 3 && e < 2 * in->edges[k]; e++)
        if (!is_between(edge[e], 0, corners - 1))
            return IN_EDGE;
    return 0;
}

static int wrong_obstacle(const scp_core *core, double *stds)
{
    const scp_inputs *in = &core->in;
    const int J = in->count, rows = core->at.N + 1, d = core->at.d;
    if (!is_between(J, 0, core->at.M))
        return IN_COUNT;
    if (!are_numbers(J * rows * d, in->means))
        return IN_MEANS;
    if (!covariances_hold(d, J * rows, in->covariances, stds))
        return IN_COVARIANCES;
    for (int j = 0; j < J; j++)
        if (!(in->radii[j] >= 0 && in->radii[j] <= LARGEST))
            return IN_RADII;
    int shapes = 0;
    for (int j = 0; j < J; j++) {
        if (!is_between(in->shape[j], -1, core->p.max_shapes - 1))
            return IN_SHAPE;
        shapes = in->shape[j] >= shapes ? in->shape[j] + 1 : shapes;
    }
    if (!is_between(in->shapes, shapes, core->p.max_shapes))
        return IN_SHAPES;
    for (int k = 0, wrong; k < in->shapes; k++)
        if ((wrong = wrong_shape(core, k)))
            return wrong;
    return 0;
}

static int wrong_input(const scp_core *core, double *stds)
{
    const scp_inputs *in = &core->in;
    const int nx = core->at.nx, rows = core->at.N + 1;
    if (!are_numbers(nx, in->x0))
        return IN_X0;
    if (!are_numbers(rows * nx, in->x_ref))
        return IN_X_REF;
    if (in->has_u_last && !are_numbers(core->at.nu, in->u_last))
        return IN_U_LAST;
    int wrong = wrong_obstacle(core, stds);
    if (wrong)
        return wrong;
    if (in->has_robot_covariance && !covariances_hold(core->at.d, rows, in->robot_covariance, NULL))
        return IN_ROBOT_COVARIANCE;
    return 0;
}

/* ---- predictions at the nodes */

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
static void scale_covariances(int d, const double *sizes, double scale, nodes of, step_room *room,
                              step *to)
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

void scale_step(scp_core *core, const step *from, const double *sizes, step *to)
{
    step_room *room = &((memory *)core->steps)->scaled;
    step scaled = *from;
    scale_covariances(core->at.d, sizes, 1 / core->p.s_ref, from->nodes, room, &scaled);
    scaled.rotation = room->rotation;
    scaled.deviation = room->deviation;
    scaled.decomposed = room->decomposed;
    memset(room->decomposed, 0, (size_t)(from->J * from->nodes.size));
    *to = scaled;
}

/* ---- bounds of y */

void set_up_step(scp_core *core)
{
    const scp_problem *p = &core->p;
    const layout *at = &core->at;
    for (int k = 0; k < at->s; k++) {
        core->lower[k] = -NONE;
        core->upper[k] = NONE;
    }
    for (int j = 0; j < at->M; j++) {
        core->lower[at->s + j] = p->s_min;
        core->upper[at->s + j] = p->s_max;
    }
    for (int k = 0; k < at->n; k++) {
        core->lower[at->u + k] = p->u_min[k % at->nu];
        core->upper[at->u + k] = p->u_max[k % at->nu];
    }
    for (int k = 0; k < at->rated; k++) {
        core->lower[at->du + k] = larger(p->du_min[k % at->nu], -NONE);
        core->upper[at->du + k] = lesser(p->du_max[k % at->nu], NONE);
    }
    for (int k = 0; k < at->N * at->nb; k++)
        core->row_price[k] = p->row_soft[k % at->nb] ? p->state_slack_weight : HARD * p->slack_weight;
}

static double row_of(const scp_core *core, int r, const double *x)
{
    return dot(core->at.nx, core->p.row + r * core->at.nx, x);
}

/* Bounds (2, ny) in which rows that are hard go as far as full braking does: all, or those that are
 * outside their bounds now. Returns whether there are any. */
static int go_as_far_as_braking(scp_core *core, int all, double *to)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    double *lower = to + at->z, *upper = to + at->ny + at->z;
    int any = 0;
    for (int r = 0; r < at->nb; r++) {
        double here = row_of(core, r, core->plain.x0);
        int low = all || here < p->row_min[r] - OUTSIDE, high = all || here > p->row_max[r] + OUTSIDE;
        if (p->row_soft[r] || !(low || high))
            continue;
        if (!any) {
            memcpy(to, core->lower, (size_t)at->ny * sizeof *to);
            memcpy(to + at->ny, core->upper, (size_t)at->ny * sizeof *to);
            brake_now(core);
            any = 1;
        }
        for (int i = 0; i < at->N; i++) {
            int stage = i + 1 < core->braking_steps ? i + 1 : core->braking_steps;
            double after = row_of(core, r, core->braking_x + stage * at->nx);
            double reference = row_of(core, r, core->x_ref + (i + 1) * at->nx);
            if (low)
                lower[i * at->nb + r] = larger(lesser(after, p->row_min[r]) - reference, -NONE);
            if (high)
                upper[i * at->nb + r] = lesser(larger(after, p->row_max[r]) - reference, NONE);
        }
    }
    return any;
}

static void read_bounds(scp_core *core)
{
    const layout *at = &core->at;
    const scp_problem *p = &core->p;
    memory *my = core->steps;
    if (at->rated) {
        double *lower = core->lower + at->du, *upper = core->upper + at->du;
        const double *last = core->plain.u_last;
        reach(core, last, lower, upper);
        for (int l = 0; l < at->nu; l++) {
            lower[l] = larger(lower[l] - (last ? last[l] : 0), -NONE);
            upper[l] = lesser(upper[l] - (last ? last[l] : 0), NONE);
        }
    }
    for (int i = 0; i < at->N; i++)
        for (int r = 0; r < at->nb; r++) {
            double reference = row_of(core, r, core->x_ref + (i + 1) * at->nx);
            core->lower[at->z + i * at->nb + r] = larger(p->row_min[r] - reference, -NONE);
            core->upper[at->z + i * at->nb + r] = lesser(p->row_max[r] - reference, NONE);
        }
    int outside = go_as_far_as_braking(core, 0, my->outside);
    core->strict_lower = outside ? my->outside : core->lower;
    core->strict_upper = outside ? my->outside + at->ny : core->upper;
    core->braked_lower = core->lower;
    core->braked_upper = core->upper;
    my->has_braked = 0;
}

void brake_bounds(scp_core *core)
{
    memory *my = core->steps;
    if (!my->has_braked && go_as_far_as_braking(core, 1, my->braked)) {
        core->braked_lower = my->braked;
        core->braked_upper = my->braked + core->at.ny;
    }
    my->has_braked = 1;
}

/* ---- state, reference and shapes */

/* Headings are angles: unwrapped, row by row, from that of the state, so that the plan never turns
 * the long way round. */
static void read_reference(scp_core *core)
{
    const int nx = core->at.nx, rows = core->at.N + 1, heading = core->p.heading;
    memcpy(core->x_ref, core->in.x_ref, (size_t)(rows * nx) * sizeof(double));
    if (heading < 0)
        return;
    double before = core->in.x0[heading], turns = 0;
    for (int i = 0; i < rows; i++) {
        double *angle = core->x_ref + i * nx + heading, given = *angle;
        turns += rint((given - before) / TURN);
        *angle = given - TURN * turns;
        before = given;
    }
}

static void read_shapes(scp_core *core)
{
    const scp_problem *p = &core->p;
    const scp_inputs *in = &core->in;
    const memory *my = core->steps;
    const int d = p->dim;
    for (int k = 0; k < in->shapes; k++) {
        const double *corner = in->corner + k * p->max_corners * d;
        const int *edge = in->edge + 2 * k * p->max_edges, edges = d == 3 ? in->edges[k] : 0;
        double *begin = my->begin + k * p->max_edges * d;
        double *along = my->along + k * (p->max_edges + p->max_corners) * d, most = 0;
        for (int e = 0; e < edges; e++) {
            memcpy(begin + e * d, corner + edge[2 * e] * d, (size_t)d * sizeof *begin);
            difference(d, corner + edge[2 * e + 1] * d, begin + e * d, along + e * d);
        }
        for (int v = 0; v < in->corners[k]; v++)
            most = larger(inner(d, corner + v * d, corner + v * d), most);
        core->solids[k] = (solid){
            .corners = in->corners[k], .faces = in->faces[k],
            .ridges = d == 3 ? edges : in->corners[k], .corner = corner,
            .normal = in->normal + k * p->max_faces * d, .offset = in->offset + k * p->max_faces,
            .begin = d == 3 ? begin : corner, .along = along, .size = sqrt(most)};
    }
}

/* Whether the robot touches an obstacle now, if they are where they are expected to be. */
static int is_touching(scp_core *core)
{
    const step *at = &core->plain;
    const int d = core->at.d, n = at->nodes.n;
    size_t mark = core->scratch.used;
    double *here = doubles(&core->scratch, (size_t)(n * d));
    int touching = 0;
    nodes_now(core, at->x0, here);
    for (int j = 0; j < at->J; j++)
        for (int k = 0; k < n; k++) {
            double y[3];
            difference(d, here + k * d, at->means + j * (at->nodes.size + 1) * d, y);
            double gap = at->shape[j] < 0 ? sqrt(inner(d, y, y))
                                          : solid_distance(d, core->solids + at->shape[j], y, NULL,
                                                           NULL, NULL);
            touching |= gap < core->p.robot_radius + core->given.radii[j] - TOUCH;
        }
    core->scratch.used = mark;
    return touching;
}

int read_step(scp_core *core)
{
    memory *my = core->steps;
    const scp_inputs *in = &core->in;
    int wrong = wrong_input(core, my->stds);
    if (wrong)
        return wrong;
    read_reference(core);
    read_shapes(core);
    core->given = (predictions){in->count, in->means, in->covariances, my->stds, in->radii, in->shape};
    double scale = core->p.sizes ? core->p.sizes[in->count] / core->p.s_ref : 1;
    predict(core, &core->given, in->has_robot_covariance ? in->robot_covariance : NULL, scale,
            &my->room, &core->plain);
    core->plain.x0 = in->x0;
    core->plain.x_ref = core->x_ref;
    core->plain.u_last = in->has_u_last ? in->u_last : NULL;
    core->wide = core->plain;
    core->wide.radii = my->wide_radii;
    core->now = &core->plain;
    core->braking_steps = -1;
    read_bounds(core);
    core->out.contact = is_touching(core);
    return 0;
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
