/* Memory and dense linear algebra, for sizes up to some hundreds.
 *
 * Matrices are stored row by row, so that products with rows (dots) and sums of rows (axpys) are all
 * there is. Both are written so that a compiler vectorises them though it must not reorder sums:
 * eight sums side by side, the same on every machine.
 *
 * Eigenvalues: Householder's tridiagonal form, then QL with implicit shifts (Golub and Van Loan,
 * Matrix Computations, chapter 8), vectors kept as rows until the end.
 */
#include <float.h>

#include "core.h"

/* ---- memory */

enum { ALIGNED = 64 };

#ifdef SCP_POISON /* for tests with AddressSanitizer: what is between two arrays is nobody's */
void __asan_poison_memory_region(const volatile void *begin, size_t size);
void __asan_unpoison_memory_region(const volatile void *begin, size_t size);

static void *owned(char *begin, size_t size)
{
    __asan_unpoison_memory_region(begin, size);
    __asan_poison_memory_region(begin + size, (ALIGNED - size % ALIGNED) % ALIGNED);
    return begin;
}
#else
#define owned(begin, size) (begin)
#endif

void *take(arena *from, size_t count, size_t size)
{
    size_t begin = (from->used + ALIGNED - 1) / ALIGNED * ALIGNED;
    from->used = begin + count * size;
    if (from->used > from->most)
        from->most = from->used;
    if (!from->base || from->used > from->size)
        return NULL;
    return owned(from->base + begin, count * size);
}

double *doubles(arena *from, size_t count)
{
    return take(from, count, sizeof(double));
}

int *ints(arena *from, size_t count)
{
    return take(from, count, sizeof(int));
}

uint8_t *bytes(arena *from, size_t count)
{
    return take(from, count, sizeof(uint8_t));
}

/* ---- vectors */

double dot(int n, const double *restrict a, const double *restrict b)
{
    double sum[8] = {0};
    int i = 0;
    for (; i + 8 <= n; i += 8)
        for (int k = 0; k < 8; k++)
            sum[k] += a[i + k] * b[i + k];
    double rest = 0;
    for (; i < n; i++)
        rest += a[i] * b[i];
    return ((sum[0] + sum[4]) + (sum[1] + sum[5])) + ((sum[2] + sum[6]) + (sum[3] + sum[7])) + rest;
}

void axpy(int n, double alpha, const double *restrict x, double *restrict y)
{
    for (int i = 0; i < n; i++)
        y[i] += alpha * x[i];
}

void scale(int n, double alpha, double *x)
{
    for (int i = 0; i < n; i++)
        x[i] *= alpha;
}

double norm2(int n, const double *a)
{
    return sqrt(dot(n, a, a));
}

double largest_abs(int n, const double *a)
{
    double most = 0;
    int numbers = 1;
    for (int i = 0; i < n; i++) {
        double size = fabs(a[i]);
        most = size > most ? size : most;
        numbers &= size >= 0;
    }
    return numbers ? most : (double)NAN;
}

/* ---- products */

/* y += A'x, rows of A `apart`, entries of x `stride`: four rows at a time, to load y less often */
static void gather(int m, int n, const double *restrict A, size_t apart, const double *restrict x,
                   size_t stride, double *restrict y)
{
    int i = 0;
    for (; i + 4 <= m; i += 4, A += 4 * apart, x += 4 * stride) {
        const double *a1 = A + apart, *a2 = a1 + apart, *a3 = a2 + apart;
        double x0 = x[0], x1 = x[stride], x2 = x[2 * stride], x3 = x[3 * stride];
        for (int k = 0; k < n; k++)
            y[k] += (x0 * A[k] + x1 * a1[k]) + (x2 * a2[k] + x3 * a3[k]);
    }
    for (; i < m; i++, A += apart, x += stride)
        axpy(n, x[0], A, y);
}

void gemv(int m, int n, const double *A, const double *x, double *y)
{
    for (int i = 0; i < m; i++)
        y[i] = dot(n, A + (size_t)i * (size_t)n, x);
}

void gemv_t(int m, int n, const double *A, const double *x, double *y)
{
    for (int i = 0; i < n; i++)
        y[i] = 0;
    gather(m, n, A, (size_t)n, x, 1, y);
}

/* C = A B, with A(i, t) = A[i row + t column] */
static void product(int m, int k, int n, const double *A, size_t row, size_t column,
                    const double *B, double *C)
{
    for (int i = 0; i < m; i++, A += row, C += n) {
        for (int j = 0; j < n; j++)
            C[j] = 0;
        gather(k, n, B, (size_t)n, A, column, C);
    }
}

void gemm(int m, int k, int n, const double *A, const double *B, double *C)
{
    product(m, k, n, A, (size_t)k, 1, B, C);
}

void gemm_tn(int k, int m, int n, const double *A, const double *B, double *C)
{
    product(m, k, n, A, 1, (size_t)m, B, C);
}

void gemm_nt(int m, int k, int n, const double *A, const double *B, double *C)
{
    for (int i = 0; i < m; i++)
        gemv(n, k, B, A + (size_t)i * (size_t)k, C + (size_t)i * (size_t)n);
}

/* ---- triangular factors */

int cholesky(int n, double *A)
{
    size_t width = (size_t)n;
    for (int i = 0; i < n; i++) {
        double *row = A + (size_t)i * width;
        for (int j = 0; j < i; j++) {
            const double *other = A + (size_t)j * width;
            row[j] = (row[j] - dot(j, row, other)) / other[j];
        }
        double left = row[i] - dot(i, row, row);
        if (!(left > 0 && left <= DBL_MAX)) /* or NaN */
            return 1;
        row[i] = sqrt(left);
        for (int j = i + 1; j < n; j++)
            row[j] = 0;
    }
    return 0;
}

void solve_lower(int n, const double *L, double *x)
{
    for (int i = 0; i < n; i++) {
        const double *row = L + (size_t)i * (size_t)n;
        x[i] = (x[i] - dot(i, row, x)) / row[i];
    }
}

void solve_lower_t(int n, const double *L, double *x)
{
    for (int i = n - 1; i >= 0; i--) {
        const double *row = L + (size_t)i * (size_t)n;
        x[i] /= row[i];
        axpy(i, -x[i], row, x);
    }
}

void invert_lower(int n, const double *L, double *inverse)
{
    size_t width = (size_t)n;
    for (int i = 0; i < n; i++) {
        const double *row = L + (size_t)i * width;
        double *to = inverse + (size_t)i * width;
        for (int j = 0; j < n; j++)
            to[j] = 0;
        for (int j = 0; j < i; j += 16) { /* rows of the inverse grow: few zeros are added */
            int some = j + 16 <= i ? 16 : i - j;
            gather(some, j + some, inverse + (size_t)j * width, width, row + j, 1, to);
        }
        scale(i, -1 / row[i], to);
        to[i] = 1 / row[i];
    }
}

/* ---- eigenvalues */

enum { SWEEPS = 30 };

/* Jacobi's rotations: one is all it takes in the plane. */
void eigen_small(int d, const double *A, double *values, double *vectors)
{
    double a[9];
    for (int i = 0; i < d; i++)
        for (int j = 0; j < d; j++) {
            a[i * d + j] = A[i * d + j];
            vectors[i * d + j] = i == j;
        }
    for (int sweep = 0; sweep < (d > 2 ? SWEEPS : d - 1); sweep++) {
        int turned = 0;
        for (int p = 0; p < d - 1; p++)
            for (int q = p + 1; q < d; q++) {
                double off = a[p * d + q], first = a[p * d + p], second = a[q * d + q];
                if (!(fabs(off) > DBL_EPSILON / 4 * sqrt(fabs(first * second)) + DBL_MIN))
                    continue;
                double theta = (second - first) / (2 * off);
                double t = 1 / (fabs(theta) + sqrt(theta * theta + 1));
                t = theta < 0 ? -t : t;
                double c = 1 / sqrt(t * t + 1), s = t * c;
                turned = 1;
                a[p * d + p] -= t * off;
                a[q * d + q] += t * off;
                a[p * d + q] = a[q * d + p] = 0;
                for (int k = 0; k < d; k++) {
                    double vp = vectors[k * d + p], vq = vectors[k * d + q];
                    vectors[k * d + p] = c * vp - s * vq;
                    vectors[k * d + q] = s * vp + c * vq;
                    if (k == p || k == q)
                        continue;
                    double ap = a[k * d + p], aq = a[k * d + q];
                    a[k * d + p] = a[p * d + k] = c * ap - s * aq;
                    a[k * d + q] = a[q * d + k] = s * ap + c * aq;
                }
            }
        if (!turned)
            break;
    }
    for (int i = 0; i < d; i++)
        values[i] = a[i * d + i];
    for (int i = 0; i < d - 1; i++)
        for (int j = 0; j < d - 1 - i; j++)
            if (values[j] > values[j + 1]) {
                double swap = values[j];
                values[j] = values[j + 1], values[j + 1] = swap;
                for (int k = 0; k < d; k++) {
                    swap = vectors[k * d + j];
                    vectors[k * d + j] = vectors[k * d + j + 1], vectors[k * d + j + 1] = swap;
                }
            }
}

/* A = Q T Q' with T tridiagonal: `diagonal` (n,), `off` (n,), last one 0, and Q = H_0 H_1 ..,
 * H_k = I - beta_k v v' with v in A's row k from k+1 on. `work` (n,) */
static void tridiagonal(int n, double *A, double *diagonal, double *off, double *beta, double *work)
{
    size_t width = (size_t)n;
    for (int k = 0; k < n; k++) {
        double *v = A + (size_t)k * width + k + 1;
        int left = n - k - 1;
        diagonal[k] = v[-1];
        beta[k] = 0;
        off[k] = left > 0 ? v[0] : 0;
        double rest = left > 1 ? dot(left - 1, v + 1, v + 1) : 0;
        if (rest == 0)
            continue;
        double length = sqrt(v[0] * v[0] + rest), first = v[0] > 0 ? v[0] + length : v[0] - length;
        off[k] = v[0] > 0 ? -length : length;
        beta[k] = 2 / (first * first + rest);
        v[0] = first;
        double *within = A + (size_t)(k + 1) * width + k + 1;
        for (int i = 0; i < left; i++)
            work[i] = dot(left, within + (size_t)i * width, v);
        scale(left, beta[k], work);
        axpy(left, -beta[k] / 2 * dot(left, v, work), v, work);
        for (int i = 0; i < left; i++) {
            double *restrict row = within + (size_t)i * width;
            const double *restrict w = work, *restrict u = v;
            double vi = v[i], wi = work[i];
            for (int j = 0; j < left; j++)
                row[j] -= vi * w[j] + wi * u[j];
        }
    }
}

/* x <- Q x */
static void turn_back(int n, const double *A, const double *beta, double *x)
{
    for (int k = n - 3; k >= 0; k--) {
        const double *v = A + (size_t)k * (size_t)n + k + 1;
        if (beta[k] != 0)
            axpy(n - k - 1, -beta[k] * dot(n - k - 1, v, x + k + 1), v, x + k + 1);
    }
}

/* Brings a matrix to entries of at most one, so that no square over- or underflows; its scale. */
static double normalised(int n, double *A)
{
    double most = largest_abs(n * n, A);
    if (most > 0 && most <= DBL_MAX)
        scale(n * n, 1 / most, A);
    return most;
}

static void rotate(int n, double c, double s, double *restrict x, double *restrict y)
{
    for (int k = 0; k < n; k++) {
        double f = y[k];
        y[k] = s * x[k] + c * f;
        x[k] = c * x[k] - s * f;
    }
}

/* One QL step on rows l .. m; rows of `turned` (n, n) turn along. */
static void ql_step(int n, int l, int m, double *d, double *e, double *turned)
{
    double g = (d[l + 1] - d[l]) / (2 * e[l]), r = sqrt(g * g + 1);
    double s = 1, c = 1, p = 0;
    g = d[m] - d[l] + e[l] / (g + (g < 0 ? -r : r));
    for (int i = m - 1; i >= l; i--) {
        double f = s * e[i], b = c * e[i];
        e[i + 1] = r = sqrt(f * f + g * g);
        if (r == 0) { /* it falls into two */
            d[i + 1] -= p;
            e[m] = 0;
            return;
        }
        s = f / r;
        c = g / r;
        g = d[i + 1] - p;
        r = (d[i] - g) * s + 2 * c * b;
        p = s * r;
        d[i + 1] = g + p;
        g = c * r - b;
        rotate(n, c, s, turned + (size_t)i * (size_t)n, turned + (size_t)(i + 1) * (size_t)n);
    }
    d[l] -= p;
    e[l] = g;
    e[m] = 0;
}

static int ql(int n, double *d, double *e, double *turned)
{
    double none = DBL_EPSILON * fmax(largest_abs(n, d), largest_abs(n, e)); /* of all: errors are */
    for (int l = 0; l < n; l++)
        for (int sweep = 0;; sweep++) {
            int m = l;
            while (m < n - 1 && fabs(e[m]) > none)
                m++;
            if (m == l)
                break;
            if (sweep == SWEEPS)
                return 1;
            ql_step(n, l, m, d, e, turned);
        }
    return 0;
}

int eigen(int n, double *A, double *values, double *vectors, arena *scratch)
{
    size_t used = scratch->used, width = (size_t)n;
    double *off = doubles(scratch, width), *beta = doubles(scratch, width);
    double *row = doubles(scratch, width);
    double most = normalised(n, A);
    int failed = !(most <= DBL_MAX);
    if (!failed) {
        tridiagonal(n, A, values, off, beta, row);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                vectors[(size_t)i * width + (size_t)j] = i == j;
        failed = ql(n, values, off, vectors);
    }
    for (int i = 0; i < n && !failed; i++) { /* ascending; rows back to A's coordinates */
        int least = i;
        for (int j = i + 1; j < n; j++)
            least = values[j] < values[least] ? j : least;
        double *to = vectors + (size_t)i * width, *from = vectors + (size_t)least * width;
        memcpy(row, from, width * sizeof(double));
        memcpy(from, to, width * sizeof(double));
        turn_back(n, A, beta, row);
        memcpy(to, row, width * sizeof(double));
        double value = values[least];
        values[least] = values[i];
        values[i] = value * (most > 0 ? most : 1);
    }
    for (int i = 0; i < n && !failed; i++) /* rows to columns */
        for (int j = 0; j < i; j++) {
            double *a = vectors + (size_t)i * width + j, *b = vectors + (size_t)j * width + i;
            double swap = *a;
            *a = *b, *b = swap;
        }
    scratch->used = used;
    return failed;
}

/* Least and largest eigenvalue of a tridiagonal matrix, by bisection with Sturm's count. */
static void extremes(int n, const double *d, const double *e, double *least, double *largest)
{
    double bound = 0;
    for (int i = 0; i < n; i++) {
        double radius = fabs(d[i]) + fabs(e[i]) + (i ? fabs(e[i - 1]) : 0);
        bound = radius > bound ? radius : bound;
    }
    double low = -bound, low_end = bound, high = -bound, high_end = bound;
    for (int halving = 0; halving < 60; halving++) { /* is any below x? are all below y? */
        double x = low + (low_end - low) / 2, y = high + (high_end - high) / 2;
        double p = 1, q = 1;
        int any = 0, all = 1;
        for (int i = 0; i < n; i++) {
            double square = i ? e[i - 1] * e[i - 1] : 0;
            p = d[i] - x - square / p;
            q = d[i] - y - square / q;
            p = fabs(p) < DBL_MIN ? -DBL_MIN : p;
            q = fabs(q) < DBL_MIN ? -DBL_MIN : q;
            any |= p < 0;
            all &= q < 0;
        }
        *(any ? &low_end : &low) = x;
        *(all ? &high_end : &high) = y;
    }
    *least = low + (low_end - low) / 2;
    *largest = high + (high_end - high) / 2;
}

/* x <- (T - value)^-1 x, by elimination with row interchanges; u0 to u2: (n,) each. */
static void tridiagonal_solve(int n, const double *d, const double *e, double value, double *x,
                              double *u0, double *u1, double *u2)
{
    double diagonal = d[0] - value, above = e[0]; /* of the row that is being eliminated */
    for (int i = 0; i < n - 1; i++) {
        double below = e[i], next = d[i + 1] - value, after = i + 1 < n - 1 ? e[i + 1] : 0;
        if (fabs(diagonal) >= fabs(below)) {
            diagonal = fabs(diagonal) < DBL_EPSILON ? DBL_EPSILON : diagonal;
            double factor = below / diagonal;
            u0[i] = diagonal, u1[i] = above, u2[i] = 0;
            diagonal = next - factor * above, above = after;
            x[i + 1] -= factor * x[i];
        } else {
            double factor = diagonal / below, first = x[i];
            u0[i] = below, u1[i] = next, u2[i] = after;
            diagonal = above - factor * next, above = -factor * after;
            x[i] = x[i + 1];
            x[i + 1] = first - factor * x[i];
        }
    }
    u0[n - 1] = fabs(diagonal) < DBL_EPSILON ? DBL_EPSILON : diagonal;
    for (int i = n - 1; i >= 0; i--) {
        if (i + 1 < n)
            x[i] -= u1[i] * x[i + 1];
        if (i + 2 < n)
            x[i] -= u2[i] * x[i + 2];
        x[i] /= u0[i];
    }
}

int eigen_least(int n, double *A, double *least, double *most_abs, double *vector, arena *scratch)
{
    size_t used = scratch->used, width = (size_t)n;
    double *d = doubles(scratch, width), *e = doubles(scratch, width);
    double *beta = doubles(scratch, width), *u0 = doubles(scratch, width);
    double *u1 = doubles(scratch, width), *u2 = doubles(scratch, width);
    double size = normalised(n, A), largest;
    int failed = !(size <= DBL_MAX);
    if (!failed) {
        tridiagonal(n, A, d, e, beta, u0);
        extremes(n, d, e, least, &largest);
        for (int i = 0; i < n; i++) /* nothing that an eigenvector could be orthogonal to */
            vector[i] = 1 + 0.3 * sin(1.7 * i);
        for (int round = 0; round < 3; round++) {
            scale(n, 1 / norm2(n, vector), vector);
            tridiagonal_solve(n, d, e, *least, vector, u0, u1, u2);
        }
        scale(n, 1 / norm2(n, vector), vector);
        turn_back(n, A, beta, vector);
        *most_abs = fmax(fabs(*least), fabs(largest)) * (size > 0 ? size : 1);
        *least *= size > 0 ? size : 1;
    }
    scratch->used = used;
    return failed;
}

/* Upper bound of what `eigen` and `eigen_least` take. */
size_t scratch_of_linalg(const scp_core *core)
{
    return 6 * ((size_t)core->at.nv * sizeof(double) + ALIGNED);
}
