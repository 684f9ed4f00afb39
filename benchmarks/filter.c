/* The filter that driftfit's record mode is measured against: a random-walk Kalman filter on the lags of an ARX model,
   written for one size. NA and NB come from the compiler's command line, so every loop has a constant length.

       gcc -O3 -march=native -shared -fPIC -DNA=2 -DNB=2 [-DTHETA_ALONE] [-DREAL=float] filter.c -o filter.so

   It applies the same rules to missing data as driftfit (a missing output is filled with its own prediction, at most NA
   times in a row; a missing input makes the samples that need it unusable) and writes the same fields. It knows neither
   weights, known changes of the drift, nor uneven time, all of which driftfit reads for every sample: less work here. */

#include <math.h>

#define N (NA + NB)
#define LARGEST 1e150

typedef struct {
    double theta[N], P[N][N], q[N], r, y_lag[NA], u_lag[NB], filled;
} filter;

#ifndef REAL
#define REAL double /* float: results in single precision */
#endif

typedef struct {
#ifdef THETA_ALONE
    REAL theta[N];
#else
    REAL theta[N], var[N], y_hat, e, s, ok;
#endif
} row;

void run(filter *f, long T, const double *y, const double *u, row *out)
{
    for (long t = 0; t < T; t++) {
        double lags[N], phi[N], g[N], y_hat = 0.0, s = f->r;
        int valid = 1, seen = fabs(y[t]) < LARGEST;

        for (int i = 0; i < NA; i++)
            lags[i] = f->y_lag[i];
        for (int i = 0; i < NB; i++)
            lags[NA + i] = f->u_lag[i];
        for (int i = 0; i < N; i++) {
            int finite = fabs(lags[i]) < LARGEST;
            phi[i] = finite ? lags[i] : 0.0;
            valid = valid && finite;
        }
        int ok = valid && seen;

        for (int i = 0; i < N; i++)
            f->P[i][i] += f->q[i];
        for (int i = 0; i < N; i++) {
            g[i] = 0.0;
            for (int j = 0; j <= i; j++)
                g[i] += f->P[i][j] * phi[j];
            for (int j = i + 1; j < N; j++)
                g[i] += f->P[j][i] * phi[j];
        }
        for (int i = 0; i < N; i++) {
            y_hat += phi[i] * f->theta[i];
            s += phi[i] * g[i];
        }
        double e = y[t] - y_hat;
        if (ok) {
            double gain = 1.0 / s;
            for (int i = 0; i < N; i++) {
                double k = gain * g[i];
                f->theta[i] += k * e;
                for (int j = 0; j <= i; j++)
                    f->P[i][j] -= k * g[j];
            }
        }

        double fill = valid && f->filled < NA ? y_hat : NAN;
        f->filled = seen ? 0.0 : f->filled + 1.0;
        for (int i = NA - 1; i > 0; i--)
            f->y_lag[i] = f->y_lag[i - 1];
        f->y_lag[0] = seen ? y[t] : fill;
        for (int i = NB - 1; i > 0; i--)
            f->u_lag[i] = f->u_lag[i - 1];
        f->u_lag[0] = u[t];

        row *o = out + t;
        for (int i = 0; i < N; i++)
            o->theta[i] = f->theta[i];
#ifndef THETA_ALONE
        for (int i = 0; i < N; i++)
            o->var[i] = f->P[i][i];
        o->y_hat = valid ? y_hat : NAN;
        o->s = valid ? s : NAN;
        o->e = ok ? e : NAN;
        o->ok = ok;
#endif
    }
}
