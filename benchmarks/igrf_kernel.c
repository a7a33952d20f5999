/* A bare kernel to measure against: the field of a spherical harmonic model to degree N at many points.
 *
 * Schmidt semi-normalised recursion in r, colatitude and longitude; Gauss coefficients linear in time; W points go
 * through the recursion side by side, so that the compiler fills the vector registers. No checks, no poles, no threads:
 * what the arithmetic costs, compiled with -O3 -march=native -ffast-math.
 */
#include <math.h>

#define N 13
#define W 16

/* g, h: [(N+1)*(N+1)] at t = 0, dg, dh per unit of t; r in units of the reference radius; out: r, theta, phi in nT. */
void igrf_block(const double *restrict g, const double *restrict dg, const double *restrict h, const double *restrict dh,
                const double *restrict t, const double *restrict x, const double *restrict y, const double *restrict z,
                double *restrict out, long n)
{
    double schmidt_diagonal[N + 1], a[N + 1][N + 1], b[N + 1][N + 1];
    schmidt_diagonal[0] = 1.0;
    for (int m = 1; m <= N; m++)
        schmidt_diagonal[m] = m == 1 ? 1.0 : sqrt((2.0 * m - 1.0) / (2.0 * m));
    for (int m = 0; m <= N; m++)
        for (int k = m + 1; k <= N; k++) {
            double root = sqrt((double)(k * k - m * m));
            a[k][m] = (2.0 * k - 1.0) / root;
            b[k][m] = k > m + 1 ? sqrt((double)((k - 1) * (k - 1) - m * m)) / root : 0.0;
        }
    for (long start = 0; start < n; start += W) {
        double ct[W], st[W], cp[W], sp[W], ratio[W], power[N + 1][W];
        double br[W], bt[W], bp[W], cm[W], sm[W], pmm[W], dmm[W];
        double tt[W];
        for (int i = 0; i < W; i++) {
            double X = x[start + i], Y = y[start + i], Z = z[start + i];
            double rho2 = X * X + Y * Y, r = sqrt(rho2 + Z * Z), rho = sqrt(rho2);
            ct[i] = Z / r, st[i] = rho / r, cp[i] = X / rho, sp[i] = Y / rho, ratio[i] = 1.0 / r;
            tt[i] = t[start + i];
            br[i] = bt[i] = bp[i] = 0.0;
            cm[i] = 1.0, sm[i] = 0.0, pmm[i] = 1.0, dmm[i] = 0.0;
            power[0][i] = ratio[i] * ratio[i];
        }
        for (int k = 1; k <= N; k++)
            for (int i = 0; i < W; i++)
                power[k][i] = power[k - 1][i] * ratio[i];
        for (int m = 0; m <= N; m++) {
            double p1[W], p2[W], d1[W], d2[W];
            for (int i = 0; i < W; i++) {
                if (m > 0) {
                    double c = cm[i] * cp[i] - sm[i] * sp[i];
                    sm[i] = sm[i] * cp[i] + cm[i] * sp[i];
                    cm[i] = c;
                    dmm[i] = schmidt_diagonal[m] * (st[i] * dmm[i] + ct[i] * pmm[i]);
                    pmm[i] *= schmidt_diagonal[m] * st[i];
                }
                p1[i] = pmm[i], d1[i] = dmm[i], p2[i] = d2[i] = 0.0;
            }
            for (int k = m; k <= N; k++) {
                if (k == 0)
                    goto next;
                double gg = g[k * (N + 1) + m], dgg = dg[k * (N + 1) + m];
                double hh = h[k * (N + 1) + m], dhh = dh[k * (N + 1) + m];
                for (int i = 0; i < W; i++) {
                    double G = gg + dgg * tt[i], H = hh + dhh * tt[i];
                    double c = (G * cm[i] + H * sm[i]) * power[k][i], s = (H * cm[i] - G * sm[i]) * power[k][i];
                    br[i] += (k + 1) * c * p1[i];
                    bt[i] -= c * d1[i];
                    bp[i] -= m * s * p1[i];
                }
            next:
                if (k < N) {
                    double A = a[k + 1][m], B = b[k + 1][m];
                    for (int i = 0; i < W; i++) {
                        double p = A * ct[i] * p1[i] - B * p2[i];
                        double d = A * (ct[i] * d1[i] - st[i] * p1[i]) - B * d2[i];
                        p2[i] = p1[i], p1[i] = p, d2[i] = d1[i], d1[i] = d;
                    }
                }
            }
        }
        for (int i = 0; i < W; i++) {
            out[3 * (start + i)] = br[i];
            out[3 * (start + i) + 1] = bt[i];
            out[3 * (start + i) + 2] = bp[i] / st[i];
        }
    }
}
