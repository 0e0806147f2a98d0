
/* Rotate rows (D, NU) until they are orthogonal, and `right` with them (Hestenes, 1958). */
static void orthogonalise(double J[D][NU], double right[D])
{
    for (int sweep = 0; sweep < 20; sweep++)
        for (int p = 0; p < D; p++)
            for (int q = p + 1; q < D; q++) {
                double pp = 0, qq = 0, pq = 0;
                for (int k = 0; k < NU; k++) {
                    pp += J[p][k] * J[p][k];
                    qq += J[q][k] * J[q][k];
                    pq += J[p][k] * J[q][k];
                }
                double angle = 0.5 * atan2(2 * pq, pp - qq), c = cos(angle), s = sin(angle);
                double one = right[p];
                right[p] = c * one + s * right[q];
                right[q] = c * right[q] - s * one;
                for (int k = 0; k < NU; k++) {
                    one = J[p][k];
                    J[p][k] = c * one + s * J[q][k];
                    J[q][k] = c * J[q][k] - s * one;
                }
            }
}

/* The coasting model's next way is as short as can be: Gauss-Newton steps of least norm. */
static int stopping_input(void *context, const double *x, double *u)
{
    double there[NX], then[NX], A[NX * NX], B[NX * NU], A2[NX * NX], unused[NX * NU];
    memcpy(u, rest, sizeof rest);
    for (int round = 0; round < 5; round++) {
        double J[D][NU] = {{0}}, way[D], squares[D] = {0}, most = 0;
        if (linearise(context, 1, x, u, 1, there, A, B) ||
            linearise(context, 1, there, rest, 1, then, A2, unused))
            return 1;
        for (int p = 0; p < D; p++) {
            int row = position[p];
            way[p] = then[row] - there[row];
            for (int i = 0; i < NX; i++)
                for (int k = 0; k < NU; k++)
                    J[p][k] += (A2[row * NX + i] - (i == row)) * B[i * NU + k];
        }
        orthogonalise(J, way);
        for (int p = 0; p < D; p++) {
            for (int k = 0; k < NU; k++)
                squares[p] += J[p][k] * J[p][k];
            most = fmax(most, squares[p]);
        }
        if (!(most <= 1e30)) /* not finite */
            return 1;
        double changed = 0, largest = 1;
        for (int k = 0; k < NU; k++) {
            double change = 0;
            for (int p = 0; p < D; p++)
                if (squares[p] > 1e-18 * most)
                    change += J[p][k] * way[p] / squares[p];
            u[k] -= change;
            changed = fmax(changed, fabs(change));
            largest = fmax(largest, fabs(u[k]));
        }
        if (changed <= 1e-9 * largest)
            break;
    }
    return 0;
}
