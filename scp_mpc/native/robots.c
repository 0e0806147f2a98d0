/* Robots: x_next = f(x, u), its exact derivatives, and second derivatives; models/.
 *
 * Linear ones; the unicycle, integrated in closed form with spherical Bessel functions; the bicycle
 * by the classical Runge-Kutta method, with derivatives of its formulas, not of the flow that they
 * approximate; and whatever the caller's functions say.
 *
 *     unicycle    x = [p1, p2, theta, v],        u = [a, omega], mu = omega h / 2, alpha = a h / 2
 *     bicycle     x = [p1, p2, theta, v, delta], u = [a, sigma], omega = v tan(delta) / L
 *     h           time advanced [s]: a share of dt
 *     z = (x, u)  state and held input together
 *     j_n         spherical Bessel functions
 *
 * Sources: NIST Digital Library of Mathematical Functions, 10.51 and 10.53; Hairer, Norsett and
 * Wanner, Solving Ordinary Differential Equations I, II.1.
 */
#include "core.h"

/* ---- linear: A x + B u */

static void linear_advance(const scp_core *core, const double *x, const double *u, double *after)
{
    const double *A = core->p.A, *B = core->p.B;
    int nx = core->at.nx, nu = core->at.nu;
    for (int i = 0; i < nx; i++, A += nx, B += nu) {
        double sum = 0;
        for (int j = 0; j < nx; j++)
            sum += A[j] * x[j];
        for (int j = 0; j < nu; j++)
            sum += B[j] * u[j];
        after[i] = sum;
    }
}

/* ---- unicycle. Ways are complex numbers: p1 + i p2. */

typedef struct {
    double re, im;
} way;

static way times(way a, double re, double im)
{
    return (way){a.re * re - a.im * im, a.re * im + a.im * re};
}

static way plus(way a, way b)
{
    return (way){a.re + b.re, a.im + b.im};
}

/* 1 / (2^k k! (2n + 2k + 1)!!), signs alternating: j_n / mu^n in powers of mu^2. Eight reach
 * rounding errors up to NARROW. */
static const double series[8][4] = {
    {1.0, 1.0 / 3, 1.0 / 15, 1.0 / 105},
    {-1.0 / 6, -1.0 / 30, -1.0 / 210, -1.0 / 1890},
    {1.0 / 120, 1.0 / 840, 1.0 / 7560, 1.0 / 83160},
    {-1.0 / 5040, -1.0 / 45360, -1.0 / 498960, -1.0 / 6486480},
    {1.0 / 362880, 1.0 / 3991680, 1.0 / 51891840, 1.0 / 778377600},
    {-1.0 / 39916800, -1.0 / 518918400, -1.0 / 7783776000, -1.0 / 132324192000},
    {1.0 / 6227020800, 1.0 / 93405312000, 1.0 / 1587890304000, 1.0 / 30169915776000},
    {-1.0 / 1307674368000, -1.0 / 22230464256000, -1.0 / 422378820864000,
     -1.0 / 8869955238144000},
};
static const double NARROW = 0.5; /* of mu^2 */

static void bessel(double mu, double j[4])
{
    double square = mu * mu;
    if (square > NARROW) { /* the recurrence is stable where mu is not small */
        j[0] = sin(mu) / mu;
        j[1] = (j[0] - cos(mu)) / mu;
        j[2] = 3 / mu * j[1] - j[0];
        j[3] = 5 / mu * j[2] - j[1];
        return;
    }
    double sum[4] = {0};
    for (int k = 7; k >= 0; k--)
        for (int n = 0; n < 4; n++)
            sum[n] = sum[n] * square + series[k][n];
    j[0] = sum[0];
    j[1] = sum[1] * mu;
    j[2] = sum[2] * square;
    j[3] = sum[3] * square * mu;
}

/* An arc: its way, and what its derivatives are made of. */
typedef struct {
    double h, half, alpha, speed, j[4];
    way turned, whole; /* h exp(i (theta + mu)); that times speed j_0 + i alpha j_1 */
} arc;

static arc arc_of(const double *x, const double *u, double h)
{
    arc a = {.h = h, .half = 0.5 * h};
    double mu = a.half * u[1], angle = x[2] + mu;
    a.alpha = a.half * u[0];
    a.speed = x[3] + a.alpha;
    bessel(mu, a.j);
    a.turned = (way){h * cos(angle), h * sin(angle)};
    a.whole = times(a.turned, a.speed * a.j[0], a.alpha * a.j[1]);
    return a;
}

static void arc_end(const arc *a, const double *x, const double *u, double *after)
{
    after[0] = x[0] + a->whole.re;
    after[1] = x[1] + a->whole.im;
    after[2] = x[2] + a->h * u[1];
    after[3] = a->speed + a->alpha;
}

/* Derivatives of the way with respect to theta, v, a and omega. */
static void arc_slopes(const arc *a, way slope[4])
{
    const double *j = a->j, half = a->half;
    slope[0] = times(a->whole, 0, 1);
    slope[1] = times(a->turned, j[0], 0);
    slope[2] = times(a->turned, half * j[0], half * j[1]);
    slope[3] = plus(times(slope[0], half, 0), times(a->turned, -half * (a->speed * j[1]),
                                                    half * (a->alpha * (j[0] - 2 * j[2]) / 3)));
}

static void unicycle_linearise(const double *x, const double *u, double h, double *after,
                               double *A, double *B)
{
    arc a = arc_of(x, u, h);
    way by[4];
    arc_end(&a, x, u, after);
    arc_slopes(&a, by);
    const double to_x[16] = {1, 0, by[0].re, by[1].re, 0, 1, by[0].im, by[1].im,
                             0, 0, 1, 0, 0, 0, 0, 1};
    const double to_u[8] = {by[2].re, by[3].re, by[2].im, by[3].im, 0, h, h, 0};
    memcpy(A, to_x, sizeof to_x);
    memcpy(B, to_u, sizeof to_u);
}

static void unicycle_curvature(const double *x, const double *u, const double *y, double h,
                               double *bent)
{
    arc a = arc_of(x, u, h);
    way by[4];
    arc_slopes(&a, by);
    const double *j = a.j, half = a.half;
    way turning = times(by[2], 0, 1), omega2 = times(by[3], 0, 2);
    omega2 = plus(omega2, times(a.whole, half, 0));
    omega2 = plus(omega2, times(a.turned, half * (a.speed * (2 * j[2] - j[0]) / 3),
                                half * (a.alpha * (2 * j[3] - 3 * j[1]) / 5)));
    const struct {
        int row, column;
        way entry;
    } second[7] = {
        {2, 2, times(a.whole, -1, 0)}, {2, 3, times(by[1], 0, 1)}, {2, 4, turning},
        {2, 5, times(by[3], 0, 1)}, {3, 5, turning},
        {4, 5, times(a.turned, -2 * half * half * j[1], half * half * (4 * j[0] - 2 * j[2]) / 3)},
        {5, 5, times(omega2, half, 0)},
    };
    memset(bent, 0, 36 * sizeof(double));
    for (int k = 0; k < 7; k++) {
        int row = second[k].row, column = second[k].column;
        double sum = y[0] * second[k].entry.re + y[1] * second[k].entry.im;
        bent[row * 6 + column] = bent[column * 6 + row] = sum;
    }
}

/* ---- bicycle: x' = g(x, u) by Runge-Kutta. Of g only p1, p2 and theta are curved, and only in
 * theta, v and delta; v and delta grow evenly. */

enum { X = 5, Z = 7, BENT = 5 }; /* states; with inputs; of these theta, v, delta, a and sigma */

static const double nodes_at[4] = {0.0, 0.5, 0.5, 1.0};
static const double weights[4] = {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6};

typedef struct {
    double c, s, v, bend, rise; /* cosine and sine of theta; tan(delta) / L and its derivative */
} wheels;

static wheels wheels_of(const scp_core *core, const double *x)
{
    double tangent = tan(x[4]), L = core->p.wheelbase;
    return (wheels){cos(x[2]), sin(x[2]), x[3], tangent / L, (1 + tangent * tangent) / L};
}

static void bicycle_rates(const scp_core *core, const wheels *w, const double *u, double *g)
{
    double omega = w->v * w->bend, side = core->p.rear * omega;
    g[0] = w->v * w->c - side * w->s;
    g[1] = w->v * w->s + side * w->c;
    g[2] = omega;
    g[3] = u[0];
    g[4] = u[1];
}

/* Derivatives of p1', p2' and theta' in theta, v and delta. */
static void bicycle_jacobian(const scp_core *core, const wheels *w, double J[3][3])
{
    double rear = core->p.rear, side = rear * w->v * w->bend, turn = w->v * w->rise;
    J[0][0] = -(w->v * w->s + side * w->c);
    J[1][0] = w->v * w->c - side * w->s;
    J[2][0] = 0;
    J[0][1] = w->c - rear * w->bend * w->s;
    J[1][1] = w->s + rear * w->bend * w->c;
    J[2][1] = w->bend;
    J[0][2] = -rear * turn * w->s;
    J[1][2] = rear * turn * w->c;
    J[2][2] = turn;
}

/* The second derivative of m'g in theta, v and delta. */
static void bicycle_hessian(const scp_core *core, const wheels *w, const double *m, double H[3][3])
{
    double rear = core->p.rear, ahead = m[0] * w->c + m[1] * w->s;
    double aside = m[1] * w->c - m[0] * w->s, turning = m[2] + rear * aside;
    H[0][0] = -w->v * (ahead + rear * w->bend * aside);
    H[0][1] = H[1][0] = aside - rear * w->bend * ahead;
    H[0][2] = H[2][0] = -rear * w->v * w->rise * ahead;
    H[1][1] = 0;
    H[1][2] = H[2][1] = turning * w->rise;
    H[2][2] = turning * w->v * (2 * core->p.wheelbase * w->bend * w->rise);
}

static void bicycle_advance(const scp_core *core, const double *x0, const double *u, double share,
                            double *after)
{
    double h = share * (core->p.dt / core->p.substeps), x[X], point[X], k[X], sum[X];
    memcpy(x, x0, sizeof x);
    for (int done = 0; done < core->p.substeps; done++) {
        for (int i = 0; i < 4; i++) {
            for (int r = 0; r < X; r++)
                point[r] = i ? x[r] + nodes_at[i] * h * k[r] : x[r];
            wheels w = wheels_of(core, point);
            bicycle_rates(core, &w, u, k);
            for (int r = 0; r < X; r++)
                sum[r] = (i ? sum[r] : 0) + weights[i] * k[r];
        }
        for (int r = 0; r < X; r++)
            x[r] += h * sum[r];
    }
    memcpy(after, x, sizeof x);
}

/* Where a Runge-Kutta step evaluates g, with W: the derivatives of theta, v and delta there. */
typedef struct {
    wheels w;
    double J[3][3], W[3][BENT];
} point;

/* One step from x, with D the derivatives of p1, p2 and theta in theta, v, delta, a, sigma so far,
 * and `since` the time since the interval began; goes on to its end. */
static void bicycle_step(const scp_core *core, double *x, const double *u, double h, double since,
                         double D[3][BENT], point at[4])
{
    double there[X], k[X], sum[X] = {0}, along[3][BENT], total[3][BENT] = {{0}};
    for (int i = 0; i < 4; i++) {
        double part = nodes_at[i] * h, later = since + part;
        for (int r = 0; r < X; r++)
            there[r] = i ? x[r] + part * k[r] : x[r];
        at[i].w = wheels_of(core, there);
        bicycle_rates(core, &at[i].w, u, k);
        bicycle_jacobian(core, &at[i].w, at[i].J);
        const double W[3][BENT] = {{0}, {0, 1, 0, later, 0}, {0, 0, 1, 0, later}};
        memcpy(at[i].W, W, sizeof W);
        for (int c = 0; c < BENT; c++)
            at[i].W[0][c] = D[2][c] + (i ? part * along[2][c] : 0);
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < BENT; c++) {
                along[r][c] = at[i].J[r][0] * at[i].W[0][c] + at[i].J[r][1] * at[i].W[1][c]
                              + at[i].J[r][2] * at[i].W[2][c];
                total[r][c] += weights[i] * along[r][c];
            }
        for (int r = 0; r < X; r++)
            sum[r] += weights[i] * k[r];
    }
    for (int r = 0; r < X; r++)
        x[r] += h * sum[r];
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < BENT; c++)
            D[r][c] += h * total[r][c];
}

static void bicycle_linearise(const scp_core *core, const double *x0, const double *u,
                              double share, double *after, double *A, double *B)
{
    int steps = core->p.substeps;
    double h = share * (core->p.dt / steps), D[3][BENT] = {{0}, {0}, {1}};
    point at[4];
    memcpy(after, x0, X * sizeof(double));
    for (int done = 0; done < steps; done++)
        bicycle_step(core, after, u, h, done * h, D, at);
    memset(A, 0, X * X * sizeof(double));
    memset(B, 0, 2 * X * sizeof(double));
    A[0] = A[X + 1] = A[3 * X + 3] = A[4 * X + 4] = 1;
    B[3 * 2] = B[4 * 2 + 1] = steps * h;
    for (int r = 0; r < 3; r++) {
        memcpy(A + r * X + 2, D[r], 3 * sizeof(double));
        memcpy(B + r * 2, D[r] + 3, 2 * sizeof(double));
    }
}

/* Back through the slopes of a step: y are costates of its end, then of its beginning. Adds
 * W'(m' Hessian of g) W of its four points, m the costates of the slopes. */
static void bicycle_back(const scp_core *core, const point at[4], double h, double *y,
                         double sum[BENT][BENT])
{
    double after[3] = {0}, total[3] = {0}, share = 0; /* in theta, v and delta */
    for (int i = 3; i >= 0; i--) {
        double m[3] = {weights[i] * h * y[0], weights[i] * h * y[1],
                       weights[i] * h * y[2] + share * h * after[0]};
        double H[3][3], HW[3][BENT];
        for (int c = 0; c < 3; c++) {
            after[c] = m[0] * at[i].J[0][c] + m[1] * at[i].J[1][c] + m[2] * at[i].J[2][c];
            total[c] += after[c];
        }
        share = nodes_at[i];
        bicycle_hessian(core, &at[i].w, m, H);
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < BENT; c++)
                HW[r][c] = H[r][0] * at[i].W[0][c] + H[r][1] * at[i].W[1][c]
                           + H[r][2] * at[i].W[2][c];
        for (int r = 0; r < BENT; r++)
            for (int c = 0; c < BENT; c++)
                sum[r][c] += at[i].W[0][r] * HW[0][c] + at[i].W[1][r] * HW[1][c]
                             + at[i].W[2][r] * HW[2][c];
    }
    for (int c = 0; c < 3; c++)
        y[2 + c] += total[c];
}

/* Steps are walked back from the last one; what is before each is walked through anew, for there
 * are few, and nothing has to be kept. */
static void bicycle_curvature(const scp_core *core, const double *x0, const double *u,
                              const double *costates, double share, double *bent)
{
    int steps = core->p.substeps;
    double h = share * (core->p.dt / steps), sum[BENT][BENT] = {{0}}, y[X];
    memcpy(y, costates, sizeof y);
    for (int last = steps - 1; last >= 0; last--) {
        double x[X], D[3][BENT] = {{0}, {0}, {1}};
        point at[4];
        memcpy(x, x0, sizeof x);
        for (int done = 0; done <= last; done++)
            bicycle_step(core, x, u, h, done * h, D, at);
        bicycle_back(core, at, h, y, sum);
    }
    memset(bent, 0, Z * Z * sizeof(double));
    for (int r = 0; r < BENT; r++)
        memcpy(bent + (2 + r) * Z + 2, sum[r], sizeof sum[r]);
}

/* ---- any robot */

int model_advance(const scp_core *core, int count, const double *x, const double *u, double share,
                  double *after)
{
    const scp_problem *p = &core->p;
    int nx = core->at.nx, nu = core->at.nu;
    if (p->model == SCP_OWN_MODEL)
        return p->own.advance(p->own.context, count, x, u, share, after);
    if (p->model == SCP_LINEAR && share != 1) /* positions between samples come with the problem */
        return 1;
    for (int i = 0; i < count; i++, x += nx, u += nu, after += nx) {
        if (p->model == SCP_LINEAR) {
            linear_advance(core, x, u, after);
        } else if (p->model == SCP_UNICYCLE) {
            arc a = arc_of(x, u, share * p->dt);
            arc_end(&a, x, u, after);
        } else {
            bicycle_advance(core, x, u, share, after);
        }
    }
    return 0;
}

int model_step(const scp_core *core, const double *x, const double *u, double *after)
{
    return model_advance(core, 1, x, u, 1.0, after);
}

int model_linearise(const scp_core *core, int count, const double *x, const double *u, double share,
                    double *after, double *A, double *B)
{
    const scp_problem *p = &core->p;
    int nx = core->at.nx, nu = core->at.nu;
    if (p->model == SCP_OWN_MODEL)
        return p->own.linearise(p->own.context, count, x, u, share, after, A, B);
    if (p->model == SCP_LINEAR && share != 1)
        return 1;
    for (int i = 0; i < count; i++) {
        if (p->model == SCP_LINEAR) {
            linear_advance(core, x, u, after);
            memcpy(A, p->A, (size_t)(nx * nx) * sizeof(double));
            memcpy(B, p->B, (size_t)(nx * nu) * sizeof(double));
        } else if (p->model == SCP_UNICYCLE) {
            unicycle_linearise(x, u, share * p->dt, after, A, B);
        } else {
            bicycle_linearise(core, x, u, share, after, A, B);
        }
        x += nx, u += nu, after += nx, A += nx * nx, B += nx * nu;
    }
    return 0;
}

static int any(int n, const double *values)
{
    for (int i = 0; i < n; i++)
        if (values[i] != 0)
            return 1;
    return 0;
}

int model_curvature(const scp_core *core, int count, const double *x, const double *u,
                    const double *costates, double share, double *bent)
{
    const scp_problem *p = &core->p;
    int nx = core->at.nx, nu = core->at.nu, size = (nx + nu) * (nx + nu);
    if (p->model == SCP_OWN_MODEL)
        return p->own.curvature(p->own.context, count, x, u, costates, share, bent);
    for (int i = 0; i < count; i++, x += nx, u += nu, costates += nx, bent += size) {
        if (p->model == SCP_LINEAR || !any(nx, costates)) /* obstacles push few nodes */
            memset(bent, 0, (size_t)size * sizeof(double));
        else if (p->model == SCP_UNICYCLE)
            unicycle_curvature(x, u, costates, share * p->dt, bent);
        else
            bicycle_curvature(core, x, u, costates, share, bent);
    }
    return 0;
}

void model_stopping_input(const scp_core *core, const double *x, double *u)
{
    const scp_problem *p = &core->p;
    int nx = core->at.nx, nu = core->at.nu;
    if (p->model == SCP_LINEAR) {
        for (int i = 0; i < nu; i++) {
            u[i] = 0;
            for (int j = 0; j < nx; j++)
                u[i] -= p->stopping[i * nx + j] * x[j];
        }
    } else if (p->model != SCP_OWN_MODEL) { /* straight on, or with the wheel held */
        u[0] = -x[3] / p->dt;
        u[1] = 0;
    } else if (p->own.stopping_input(p->own.context, x, u)) {
        memcpy(u, p->rest, (size_t)nu * sizeof(double));
    }
}
