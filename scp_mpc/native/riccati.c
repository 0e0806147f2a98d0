/* Derivatives of the dynamics along a plan, and what follows from them by a Riccati pass: how
 * outputs answer to coordinates v in which the cost is a circle.
 *
 * With P the cost to go after an interval,
 *
 *     M = 2 R + B'P B = T^-1 T^-T,    K = M^-1 B'P A,    v_i = T^-T (du_i + K de)
 *
 * are such coordinates. They take O(N) for a plan and O(N^2) for the responses of all outputs,
 * where a Cholesky factor of the dense Hessian takes O(N^3), and they are causal: v_i acts on
 * interval i and later ones only.
 *
 *     D       block bidiagonal, unit diagonal, -A below:  D e = B u + drift
 *     de, du  (N, nx), (N, nu) changes of deviations and inputs
 *     C, D, at    derivatives of positions: see `derivatives`
 *
 * Source: Bertsekas, Dynamic Programming and Optimal Control I, 4.1.
 */
#include <float.h>

#include "core.h"

static const double ridges[] = {0, 1e-14, 1e-12, 1e-10}; /* of the Hessian's largest diagonal */

void lay_out_sensitivity(const scp_core *core, arena *from, sensitivity *by)
{
    size_t N = (size_t)core->at.N, nx = (size_t)core->at.nx, nu = (size_t)core->at.nu;
    by->K = doubles(from, N * nu * nx);
    by->T = doubles(from, N * nu * nu);
    by->A = doubles(from, N * nx * nx);
    by->E = doubles(from, N * nx * N * nu);
    by->S = doubles(from, (size_t)core->at.ny * (size_t)core->at.nv);
}

/* ---- small products */

void add_product(int m, int n, const double *restrict A, const double *restrict x,
                 double *restrict y)
{
    for (int i = 0; i < m; i++, A += n) {
        double sum = 0;
        for (int j = 0; j < n; j++)
            sum += A[j] * x[j];
        y[i] += sum;
    }
}

void add_product_t(int m, int n, const double *restrict A, const double *restrict x,
                   double *restrict y)
{
    for (int i = 0; i < m; i++, A += n)
        for (int j = 0; j < n; j++)
            y[j] += A[j] * x[i];
}

void derivatives_roll(const scp_core *core, const derivatives *D, double *e)
{
    int nx = core->at.nx;
    for (int i = 1; i < core->at.N; i++)
        add_product(nx, nx, D->A + i * nx * nx, e + (i - 1) * nx, e + i * nx);
}

void derivatives_costates(const scp_core *core, const derivatives *D, double *nu)
{
    int nx = core->at.nx;
    for (int i = core->at.N - 1; i > 0; i--)
        add_product_t(nx, nx, D->A + i * nx * nx, nu + i * nx, nu + (i - 1) * nx);
}

void derivatives_positions(const scp_core *core, const derivatives *D, const double *de,
                           const double *du, double *dp)
{
    int nx = core->at.nx, nu = core->at.nu, part = core->at.nodes.n * core->at.d;
    int m = (core->at.nodes.K - 1) * part;
    memset(dp, 0, (size_t)(core->at.nodes.size * core->at.d) * sizeof(double));
    for (int i = 0; i < core->at.N; i++, dp += m + part) {
        if (m && i)
            add_product(m, nx, D->C + i * m * nx, de + (i - 1) * nx, dp);
        if (m)
            add_product(m, nu, D->D + i * m * nu, du + i * nu, dp);
        add_product(part, nx, D->at + i * part * nx, de + i * nx, dp + m);
    }
}

/* ---- the Riccati pass */

/* T = L^-1 of M = L L'; 0 if M is positive definite. */
static int inverse_root(int n, double *M, double *T)
{
    if (n == 2) {
        double a = M[0], b = M[2] / a, c = M[3] - b * M[2];
        if (!(a > 0 && c > 0 && a <= DBL_MAX && c <= DBL_MAX))
            return 1;
        a = 1 / sqrt(a), c = 1 / sqrt(c);
        T[0] = a, T[1] = 0, T[2] = -b * c, T[3] = c;
        return 0;
    }
    if (cholesky(n, M))
        return 1;
    invert_lower(n, M, T);
    return 0;
}

/* What a pass takes from scratch: P (nx, nx), P A (nx, nx), P B (nx, nu), M (nu, nu), B'P A and
 * T B'P A (nu, nx). */
typedef struct {
    double *P, *PA, *PB, *M, *BPA, *W;
} ahead;

static ahead ahead_of(scp_core *core)
{
    arena *room = &core->scratch;
    size_t nx = (size_t)core->at.nx, nu = (size_t)core->at.nu;
    ahead a;
    a.P = doubles(room, nx * nx);
    a.PA = doubles(room, nx * nx);
    a.PB = doubles(room, nx * nu);
    a.M = doubles(room, nu * nu);
    a.BPA = doubles(room, nu * nx);
    a.W = doubles(room, nu * nx);
    return a;
}

/* C = A B and C = A'B for small ones. */
static inline void multiply(int m, int k, int n, const double *restrict A, const double *restrict B,
                            double *restrict C)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) {
            double sum = 0;
            for (int l = 0; l < k; l++)
                sum += A[i * k + l] * B[l * n + j];
            C[i * n + j] = sum;
        }
}

static inline void multiply_t(int k, int m, int n, const double *restrict A,
                              const double *restrict B, double *restrict C)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) {
            double sum = 0;
            for (int l = 0; l < k; l++)
                sum += A[l * m + i] * B[l * n + j];
            C[i * n + j] = sum;
        }
}

/* One interval backwards: K and T, and P <- 2 Q + A'P A - W'W, W = T B'P A. */
static inline int one_back(const scp_core *core, int nx, int nu, const double *A, const double *B,
                           double ridge, ahead *a, double *K, double *T)
{
    multiply(nx, nx, nu, a->P, B, a->PB);
    multiply(nx, nx, nx, a->P, A, a->PA);
    multiply_t(nx, nu, nu, B, a->PB, a->M);
    for (int i = 0; i < nu * nu; i++)
        a->M[i] += 2 * core->p.R[i];
    for (int i = 0; i < nu; i++)
        a->M[i * nu + i] += ridge;
    if (inverse_root(nu, a->M, T))
        return 1;
    multiply_t(nx, nu, nx, B, a->PA, a->BPA);
    multiply(nu, nu, nx, T, a->BPA, a->W);
    multiply_t(nu, nu, nx, T, a->W, K);
    for (int i = 0; i < nx; i++)
        for (int j = 0; j <= i; j++) {
            double sum = 2 * core->p.Q[i * nx + j];
            for (int l = 0; l < nx; l++)
                sum += A[l * nx + i] * a->PA[l * nx + j];
            for (int l = 0; l < nu; l++)
                sum -= a->W[l * nx + i] * a->W[l * nx + j];
            a->P[i * nx + j] = a->P[j * nx + i] = sum;
        }
    return 0;
}

/* K and T along derivatives, the Hessian's diagonal raised; 0, or it is not positive definite. */
static int gains(scp_core *core, const double *A, const double *B, double ridge, double *K,
                 double *T, double *costs)
{
    int nx = core->at.nx, nu = core->at.nu, failed = 0;
    size_t used = core->scratch.used;
    ahead a = ahead_of(core);
    for (int i = 0; i < nx * nx; i++)
        a.P[i] = 2 * core->p.Qf[i];
    for (int i = core->at.N - 1; i >= 0 && !failed; i--) {
        const double *Ai = A + i * nx * nx, *Bi = B + i * nx * nu;
        double *Ki = K + i * nu * nx, *Ti = T + i * nu * nu;
        if (costs)
            copy_doubles(nx * nx, a.P, costs + i * nx * nx);
        if (nx == 4 && nu == 2) /* constants, for the compiler */
            failed = one_back(core, 4, 2, Ai, Bi, ridge, &a, Ki, Ti);
        else if (nx == 5 && nu == 2)
            failed = one_back(core, 5, 2, Ai, Bi, ridge, &a, Ki, Ti);
        else
            failed = one_back(core, nx, nu, Ai, Bi, ridge, &a, Ki, Ti);
    }
    core->scratch.used = used;
    return failed;
}

/* Largest diagonal entry of the Hessian 2 (R + G'Q G). */
static double largest_diagonal(scp_core *core, const double *A, const double *B)
{
    int nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used;
    ahead a = ahead_of(core);
    double most = 0;
    for (int i = 0; i < nx * nx; i++)
        a.P[i] = 2 * core->p.Qf[i];
    for (int i = core->at.N - 1; i >= 0; i--) {
        multiply(nx, nx, nu, a.P, B + i * nx * nu, a.PB);
        multiply_t(nx, nu, nu, B + i * nx * nu, a.PB, a.M);
        for (int k = 0; k < nu; k++)
            most = fmax(most, a.M[k * nu + k] + 2 * core->p.R[k * nu + k]);
        multiply(nx, nx, nx, a.P, A + i * nx * nx, a.PA);
        multiply_t(nx, nx, nx, A + i * nx * nx, a.PA, a.P);
        for (int k = 0; k < nx * nx; k++)
            a.P[k] += 2 * core->p.Q[k];
    }
    core->scratch.used = used;
    return most;
}

/* Gains; with a ridge where rounding ate what is definite. 0, or the derivatives are no numbers.
 * `costs` (N, nx, nx), P after each interval, may be NULL. */
static int riccati(scp_core *core, const double *A, const double *B, double *K, double *T,
                   double *costs)
{
    int failed = gains(core, A, B, 0, K, T, costs);
    double most = failed ? largest_diagonal(core, A, B) : 0;
    for (size_t k = 1; k < sizeof ridges / sizeof ridges[0] && failed; k++)
        failed = gains(core, A, B, ridges[k] * most, K, T, costs);
    return failed;
}

/* ---- responses */

/* y (w,) += sum of k rows, `apart`, times coefficients, `stride`: four at a time */
static void sum_rows(int k, int w, const double *c, int stride, const double *X, int apart,
                     double *restrict y)
{
    for (; k >= 4; k -= 4, c += 4 * stride, X += 4 * apart) {
        const double *x1 = X + apart, *x2 = x1 + apart, *x3 = x2 + apart;
        double c0 = c[0], c1 = c[stride], c2 = c[2 * stride], c3 = c[3 * stride];
        for (int l = 0; l < w; l++)
            y[l] += (c0 * X[l] + c1 * x1[l]) + (c2 * x2[l] + c3 * x3[l]);
    }
    for (; k > 0; k--, c += stride, X += apart)
        axpy(w, c[0], X, y);
}

/* Likewise, of few that are not zero. */
static void sum_some(int k, int w, const double *c, const double *X, int apart, double *y)
{
    for (int j = 0; j < k; j++)
        if (c[j] != 0)
            axpy(w, c[j], X + j * apart, y);
}

/* The closed loop A - B K, E, and rows u of S:
 *     e_i = (A - B K) e_before + B T'v_i,    u_i = T'v_i - K e_before */
static void respond_states(const scp_core *core, const derivatives *D, sensitivity *by)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu, n = at->n, nv = at->nv;
    for (int i = 0; i < at->N; i++) {
        const double *B = D->B + i * nx * nu, *K = by->K + i * nu * nx, *T = by->T + i * nu * nu;
        double *closed = by->A + i * nx * nx, *E = by->E + i * nx * n;
        const double *before = i ? E - nx * n : E;
        double *U = by->S + (at->u + i * nu) * nv;
        int w = i * nu;
        for (int r = 0; r < nu; r++) {
            memset(U + r * nv, 0, (size_t)nv * sizeof(double));
            if (i)
                sum_rows(nx, w, K + r * nx, 1, before, n, U + r * nv);
            scale(w, -1, U + r * nv);
            for (int c = r; c < nu; c++)
                U[r * nv + w + c] = T[c * nu + r];
        }
        for (int r = 0; r < nx; r++) {
            for (int c = 0; c < nx; c++) {
                closed[r * nx + c] = D->A[(i * nx + r) * nx + c];
                for (int k = 0; k < nu; k++)
                    closed[r * nx + c] -= B[r * nu + k] * K[k * nx + c];
            }
            memset(E + r * n, 0, (size_t)n * sizeof(double));
            if (i)
                sum_rows(nx, w, closed + r * nx, 1, before, n, E + r * n);
            for (int c = 0; c < nu; c++)
                E[r * n + w + c] = dot(c + 1, B + r * nu, T + c * nu);
        }
    }
}

/* Rows of S for positions, changes and bounded states. */
static void respond_outputs(const scp_core *core, const derivatives *D, sensitivity *by)
{
    const layout *at = &core->at;
    int nx = at->nx, nu = at->nu, n = at->n, nv = at->nv, part = at->nodes.n * at->d;
    int m = (at->nodes.K - 1) * part;
    double *p = by->S + at->p * nv, *du = by->S + at->du * nv, *z = by->S + at->z * nv;
    memset(p, 0, (size_t)at->u * (size_t)nv * sizeof(double)); /* and rows of sizes */
    memset(du, 0, (size_t)(at->ny - at->du) * (size_t)nv * sizeof(double));
    for (int i = 0; i < at->N; i++) {
        const double *E = by->E + i * nx * n, *U = by->S + (at->u + i * nu) * nv;
        int w = (i + 1) * nu;
        for (int r = 0; r < m; r++, p += nv) {
            if (i)
                sum_some(nx, w - nu, D->C + (i * m + r) * nx, E - nx * n, n, p);
            sum_some(nu, w, D->D + (i * m + r) * nu, U, nv, p);
        }
        for (int r = 0; r < part; r++, p += nv)
            sum_some(nx, w, D->at + (i * part + r) * nx, E, n, p);
        for (int r = 0; r < at->nb; r++, z += nv)
            sum_some(nx, w, core->p.row + r * nx, E, n, z);
        for (int k = 0; at->rated && k < nu; k++, du += nv) {
            copy_doubles(w, U + k * nv, du);
            if (i)
                axpy(w - nu, -1, U + (k - nu) * nv, du);
        }
    }
    for (int j = 0; j < at->moving; j++)
        by->S[(at->s + j) * nv + n + j] = 1 / sqrt(2 * core->p.s_weight);
}

int sensitivity_along(scp_core *core, const derivatives *D, sensitivity *by)
{
    if (riccati(core, D->A, D->B, by->K, by->T, NULL))
        return 1;
    respond_states(core, D, by);
    respond_outputs(core, D, by);
    return 0;
}

void respond(const scp_core *core, const derivatives *D, const sensitivity *by, const double *v,
             double sign, double *de, double *du)
{
    int nx = core->at.nx, nu = core->at.nu;
    memset(de, 0, (size_t)(core->at.N * nx) * sizeof(double));
    for (int i = 0; i < core->at.N; i++, v += nu, du += nu, de += nx) {
        const double *K = by->K + i * nu * nx, *T = by->T + i * nu * nu;
        for (int k = 0; k < nu; k++) {
            double sum = 0;
            for (int r = k; r < nu; r++)
                sum += T[r * nu + k] * v[r];
            du[k] = sign * sum;
            for (int c = 0; i && c < nx; c++)
                du[k] -= K[k * nx + c] * de[c - nx];
        }
        if (i)
            add_product(nx, nx, D->A + i * nx * nx, de - nx, de);
        add_product(nx, nu, D->B + i * nx * nu, du, de);
    }
}

/* Backwards through the closed loop: with F_x and F_u the gradients of all columns' stages in e and
 * u, and `later` those of all that comes after in e_i,
 *     rows v_i = T F_u + T B'later,    later <- F_x - K'F_u + (A - B K)'later */
void curvature_in_v(scp_core *core, const sensitivity *by, const double *stages, const double *sway,
                    double *W)
{
    const layout *at = &core->at;
    int N = at->N, nx = at->nx, nu = at->nu, n = at->n, nv = at->nv, size = nx + nu;
    size_t used = core->scratch.used, block = (size_t)(nx * n);
    double *later = doubles(&core->scratch, block), *sooner = doubles(&core->scratch, block);
    double *F = doubles(&core->scratch, (size_t)(size * n)), *F_u = F + nx * n;
    memset(later, 0, block * sizeof(double));
    memset(W, 0, (size_t)nv * (size_t)nv * sizeof(double));
    for (int i = N - 1; i >= 0; i--) {
        const double *H = stages + i * size * size, *K = by->K + i * nu * nx;
        const double *T = by->T + i * nu * nu, *E = by->E + i * nx * n;
        const double *U = by->S + (at->u + i * nu) * nv, *before = i ? E - nx * n : E;
        int w = (i + 1) * nu, heading = core->p.heading;
        if (sway)
            axpy(w, sway[i], E + heading * n, later + heading * n);
        memset(F, 0, (size_t)(size * n) * sizeof(double));
        for (int r = i ? 0 : nx; r < size; r++) {
            if (i)
                sum_some(nx, w - nu, H + r * size, before, n, F + r * n);
            sum_some(nu, w, H + r * size + nx, U, nv, F + r * n);
        }
        for (int k = 0; k < nu; k++) {
            double *row = W + (i * nu + k) * nv;
            sum_rows(k + 1, w, T + k * nu, 1, F_u, n, row);
            sum_rows(nx, w, E + i * nu + k, n, later, n, row);
            for (int c = 0; c < i * nu + k; c++)
                W[c * nv + i * nu + k] = row[c];
        }
        scale(nu * n, -1, F_u);
        for (int c = 0; i && c < nx; c++) {
            double *row = sooner + c * n;
            copy_doubles(w - nu, F + c * n, row);
            sum_rows(nu, w - nu, K + c, nx, F_u, n, row);
            sum_rows(nx, w - nu, by->A + i * nx * nx + c, nx, later, n, row);
        }
        double *swap = later;
        later = sooner, sooner = swap;
    }
    core->scratch.used = used;
}

/* ---- feedback */

/* Backwards: with f the gradient of the cost to go after an interval and its drift,
 *     k = M^-1 B'f,    f <- A'f - K'B'f */
static void feed_forward(scp_core *core, const double *A, const double *B, const double *K,
                         const double *T, const double *costs, const double *drift, double *k)
{
    int nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used;
    double *f = doubles(&core->scratch, (size_t)nx), *before = doubles(&core->scratch, (size_t)nx);
    double *r = doubles(&core->scratch, (size_t)nu);
    memset(f, 0, (size_t)nx * sizeof(double));
    memset(k, 0, (size_t)core->at.n * sizeof(double));
    for (int i = core->at.N - 1; i >= 0; i--) {
        add_product(nx, nx, costs + i * nx * nx, drift + i * nx, f);
        memset(r, 0, (size_t)nu * sizeof(double));
        add_product_t(nx, nu, B + i * nx * nu, f, r);
        for (int c = 0; c < nu; c++) { /* T'T r */
            const double *row = T + (i * nu + c) * nu;
            axpy(c + 1, dot(c + 1, row, r), row, k + i * nu);
        }
        memset(before, 0, (size_t)nx * sizeof(double));
        add_product_t(nx, nx, A + i * nx * nx, f, before);
        for (int c = 0; c < nu; c++)
            axpy(nx, -r[c], K + (i * nu + c) * nx, before);
        copy_doubles(nx, before, f);
    }
    core->scratch.used = used;
}

int regulate(scp_core *core, const double *A, const double *B, double *drift, double *du)
{
    int N = core->at.N, nx = core->at.nx, nu = core->at.nu;
    size_t used = core->scratch.used;
    double *K = doubles(&core->scratch, (size_t)(N * nu * nx));
    double *T = doubles(&core->scratch, (size_t)(N * nu * nu));
    double *costs = doubles(&core->scratch, (size_t)(N * nx * nx));
    double *k = doubles(&core->scratch, (size_t)(N * nu));
    int failed = riccati(core, A, B, K, T, costs);
    if (!failed)
        feed_forward(core, A, B, K, T, costs, drift, k);
    for (int i = 0; i < N && !failed; i++) { /* du = -k - K de */
        double *de = drift + i * nx, *change = du + i * nu;
        for (int c = 0; c < nu; c++)
            change[c] = -k[i * nu + c] - (i ? dot(nx, K + (i * nu + c) * nx, de - nx) : 0);
        if (i)
            add_product(nx, nx, A + i * nx * nx, de - nx, de);
        add_product(nx, nu, B + i * nx * nu, change, de);
    }
    core->scratch.used = used;
    return failed;
}

/* All that may be taken at once: `regulate` above a pass, or `curvature_in_v`. */
size_t scratch_of_riccati(const scp_core *core)
{
    int nx = core->at.nx, nu = core->at.nu, takes = 10;
    int pass = 2 * nx * nx + 3 * nx * nu + nu * nu, forward = 2 * nx + nu;
    int most = core->at.N * (nu * nx + nu * nu + nx * nx + nu) + (pass > forward ? pass : forward);
    int bent = (3 * nx + nu) * core->at.n;
    return ((size_t)(most > bent ? most : bent) + 8 * (size_t)takes) * sizeof(double);
}
