/* Vectors of two or three numbers. d is a constant wherever these are inlined: what is written for
 * any dimension is compiled for each. */
#ifndef SCP_SMALL_H
#define SCP_SMALL_H

static inline double larger(double a, double b) { return a > b ? a : b; } /* fmax is a call */

static inline double lesser(double a, double b) { return a < b ? a : b; }

static inline double inner(const int d, const double *a, const double *b)
{
    double sum = a[0] * b[0];
    for (int l = 1; l < d; l++)
        sum += a[l] * b[l];
    return sum;
}

static inline double greatest(const int d, const double *a)
{
    double most = a[0];
    for (int l = 1; l < d; l++)
        most = larger(a[l], most);
    return most;
}

static inline double smallest(const int d, const double *a)
{
    double least = a[0];
    for (int l = 1; l < d; l++)
        least = lesser(a[l], least);
    return least;
}

static inline void difference(const int d, const double *a, const double *b, double *out)
{
    for (int l = 0; l < d; l++)
        out[l] = a[l] - b[l];
}

/* C = A B with A (m, k), B (k, n). */
static inline void times(const int m, const int k, const int n, const double *A, const double *B,
                         double *C)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) {
            C[i * n + j] = A[i * k] * B[j];
            for (int l = 1; l < k; l++)
                C[i * n + j] += A[i * k + l] * B[l * n + j];
        }
}

/* R'v and R v for eigenvectors in the columns of R. */
static inline void to_eigenframe(const int d, const double *R, const double *v, double *out)
{
    times(1, d, d, v, R, out);
}

static inline void to_world(const int d, const double *R, const double *v, double *out)
{
    times(d, d, 1, R, v, out);
}

#endif
