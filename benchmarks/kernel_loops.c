/* The loops that the compiled kernel is measured against, written by hand for gcc's vector types.
 *
 * Eight hypotheses to a vector; state, sums and counts in registers; sine and cosine by one inlined polynomial; what
 * depends on parameters alone outside the loop. They do less than the kernel: no row is ever invalid, a divergence is not
 * looked for, and angles beyond some thousand radians are wrong.
 *
 * Arrays: p (n_p, B), x0 (n_x), u (N, n_u), y (N, n_s), eps (n_s), sse (n_s, B), cnt (B); blocks of lanes b0 <= b < b1.
 */
#include <math.h>
#include <stdint.h>

typedef double V __attribute__((vector_size(64)));
typedef int64_t I __attribute__((vector_size(64)));
#define INLINE static inline __attribute__((always_inline))

INLINE V splat(double x) { return (V){x, x, x, x, x, x, x, x}; }

INLINE V root(V x) {
    V r = x;
    for (int i = 0; i < 8; i++) r[i] = sqrt(x[i]);
    return r;
}

INLINE void sine_cosine(V x, V *s, V *c) {
    const double round = 6755399441055744.0;
    V t = x * 0.63661977236758134308 + round, k = t - round;
    I q = (I)t;
    V r = x - k * 1.57079632679489655800e+00;
    r = r - k * 6.12323399573676603587e-17;
    V z = r * r;
    V p = z * 1.58962301576546568060e-10 - 2.50507477628578072866e-8;
    p = p * z + 2.75573136213857245213e-6;
    p = p * z - 1.98412698295895385996e-4;
    p = p * z + 8.33333333332211858878e-3;
    p = p * z - 1.66666666666666307295e-1;
    V sine = r * (p * z + 1.0);
    p = z * -1.13585365213876817300e-11 + 2.08757008419747316778e-9;
    p = p * z - 2.75573141792967388112e-7;
    p = p * z + 2.48015872888517045348e-5;
    p = p * z - 1.38888888888730564116e-3;
    p = p * z + 4.16666666666665929218e-2;
    p = p * z - 0.5;
    V cosine = p * z + 1.0;
    I odd = -(q & 1);
    V a = (V)((odd & (I)cosine) | (~odd & (I)sine)), b = (V)((odd & (I)sine) | (~odd & (I)cosine));
    *s = (V)((I)a ^ ((q << 62) & INT64_MIN));
    *c = (V)((I)b ^ (((q + 1) << 62) & INT64_MIN));
}

INLINE void score(int n, const V *signal, const double *y, const double *eps, long least, V *sum, I *inliers) {
    I near = (I)splat(0.0);
    for (int i = 0; i < n; i++) {
        V e = signal[i] - splat(y[i]);
        sum[i] += e * e;
        near -= (V)((I)e & INT64_MAX) < splat(eps[i]);
    }
    *inliers -= near >= least;
}

INLINE void store(int n, long B, long b, const V *sum, I inliers, double *sse, int64_t *cnt) {
    for (int i = 0; i < n; i++) *(V *)(sse + i * B + b) = sum[i];
    *(I *)(cnt + b) = inliers;
}

/* Planar rotorcraft: x, z, theta; thrust, moment; mass, inertia, drag. */
typedef struct { V drag, per_mass; } Rotorcraft;

INLINE void rotorcraft_acceleration(V theta, V vx, V vz, V thrust, V drag, const Rotorcraft *p, V *ax, V *az) {
    V s, c;
    sine_cosine(theta, &s, &c);
    *ax = -(thrust * s + drag * vx * c) * p->per_mass;
    *az = (thrust * c - drag * vz * s) * p->per_mass - 9.81;
}

void rotorcraft(long B, long b0, long b1, const double *p, const double *x0, const double *u, const double *y, long N,
                const double *eps, long least, double h, double *sse, int64_t *cnt) {
    for (long b = b0; b < b1; b += 8) {
        Rotorcraft P = {*(V *)(p + 2 * B + b), 1.0 / *(V *)(p + b)};
        V per_inertia = 1.0 / *(V *)(p + B + b);
        V x = splat(x0[0]), z = splat(x0[1]), t = splat(x0[2]), vx = splat(x0[3]), vz = splat(x0[4]), w = splat(x0[5]);
        V sum[9];
        I inliers = (I)splat(0.0);
        for (int i = 0; i < 9; i++) sum[i] = splat(0.0);
        for (long j = 0; j < N; j++) {
            V T = splat(u[2 * j]), D = P.drag * splat(fabs(u[2 * j])), a = 0.177 * splat(u[2 * j + 1]) * per_inertia;
            V ax1, az1, ax2, az2, ax3, az3, ax4, az4;
            double h2 = h / 2, h6 = h / 6;
            rotorcraft_acceleration(t, vx, vz, T, D, &P, &ax1, &az1);
            V signal[9] = {x, z, t, vx, vz, w, ax1, az1, a};
            score(9, signal, y + 9 * j, eps, least, sum, &inliers);
            V w2 = w + h2 * a, vx2 = vx + h2 * ax1, vz2 = vz + h2 * az1;
            rotorcraft_acceleration(t + h2 * w, vx2, vz2, T, D, &P, &ax2, &az2);
            V vx3 = vx + h2 * ax2, vz3 = vz + h2 * az2;
            rotorcraft_acceleration(t + h2 * w2, vx3, vz3, T, D, &P, &ax3, &az3);
            V w4 = w + h * a, vx4 = vx + h * ax3, vz4 = vz + h * az3;
            rotorcraft_acceleration(t + h * w2, vx4, vz4, T, D, &P, &ax4, &az4);
            x += h6 * (vx + vx4 + 2.0 * (vx2 + vx3));
            z += h6 * (vz + vz4 + 2.0 * (vz2 + vz3));
            t += h6 * (w + w4 + 2.0 * (w2 + w2));
            vx += h6 * (ax1 + ax4 + 2.0 * (ax2 + ax3));
            vz += h6 * (az1 + az4 + 2.0 * (az2 + az3));
            w += h * a;
        }
        store(9, B, b, sum, inliers, sse, cnt);
    }
}

/* Quadrotor: position, quaternion, velocity, body rates; thrust, three moments; mass, three inertias, drag. */
typedef struct { V per_mass, drag, I[3], per_I[3]; } Quadrotor;
typedef struct { V s[13]; } State;

INLINE State quadrotor_slope(const State *x, const V *u, const Quadrotor *p) {
    const V *q = x->s + 3, *v = x->s + 7, *w = x->s + 10;
    State d;
    for (int i = 0; i < 3; i++) d.s[i] = v[i];
    d.s[3] = -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]);
    d.s[4] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]);
    d.s[5] = 0.5 * (q[0] * w[1] - q[1] * w[2] + q[3] * w[0]);
    d.s[6] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]);
    d.s[7] = (2.0 * (q[1] * q[3] + q[0] * q[2]) * u[0] - p->drag * v[0]) * p->per_mass;
    d.s[8] = (2.0 * (q[2] * q[3] - q[0] * q[1]) * u[0] - p->drag * v[1]) * p->per_mass;
    d.s[9] = ((1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])) * u[0] - p->drag * v[2]) * p->per_mass - 9.81;
    d.s[10] = (u[1] + (p->I[1] - p->I[2]) * w[1] * w[2]) * p->per_I[0];
    d.s[11] = (u[2] + (p->I[2] - p->I[0]) * w[2] * w[0]) * p->per_I[1];
    d.s[12] = (u[3] + (p->I[0] - p->I[1]) * w[0] * w[1]) * p->per_I[2];
    return d;
}

INLINE State moved(const State *x, double h, const State *d) {
    State r;
    for (int i = 0; i < 13; i++) r.s[i] = x->s[i] + h * d->s[i];
    return r;
}

void quadrotor(long B, long b0, long b1, const double *p, const double *x0, const double *u, const double *y, long N,
               const double *eps, long least, double h, double *sse, int64_t *cnt) {
    for (long b = b0; b < b1; b += 8) {
        Quadrotor P = {.per_mass = 1.0 / *(V *)(p + b), .drag = *(V *)(p + 4 * B + b)};
        for (int i = 0; i < 3; i++) P.I[i] = *(V *)(p + (i + 1) * B + b), P.per_I[i] = 1.0 / P.I[i];
        State x;
        for (int i = 0; i < 13; i++) x.s[i] = splat(x0[i]);
        V sum[19];
        I inliers = (I)splat(0.0);
        for (int i = 0; i < 19; i++) sum[i] = splat(0.0);
        for (long j = 0; j < N; j++) {
            V U[4] = {splat(u[4 * j]), splat(u[4 * j + 1]), splat(u[4 * j + 2]), splat(u[4 * j + 3])};
            State k1 = quadrotor_slope(&x, U, &P);
            V signal[19], dot = splat(0.0);
            for (int i = 0; i < 13; i++) signal[i] = x.s[i];
            for (int i = 0; i < 6; i++) signal[13 + i] = k1.s[7 + i];
            for (int i = 3; i < 7; i++) dot += x.s[i] * splat(y[19 * j + i]);
            for (int i = 3; i < 7; i++) signal[i] = (V)((I)x.s[i] ^ ((dot < 0.0) & INT64_MIN));
            score(19, signal, y + 19 * j, eps, least, sum, &inliers);
            State m = moved(&x, h / 2, &k1), k2 = quadrotor_slope(&m, U, &P);
            m = moved(&x, h / 2, &k2);
            State k3 = quadrotor_slope(&m, U, &P);
            m = moved(&x, h, &k3);
            State k4 = quadrotor_slope(&m, U, &P);
            for (int i = 0; i < 13; i++) x.s[i] += h / 6 * (k1.s[i] + k4.s[i] + 2.0 * (k2.s[i] + k3.s[i]));
            V n = x.s[3] * x.s[3] + x.s[4] * x.s[4] + x.s[5] * x.s[5] + x.s[6] * x.s[6], r = 1.0 / root(n);
            for (int i = 3; i < 7; i++) x.s[i] *= r;
        }
        store(19, B, b, sum, inliers, sse, cnt);
    }
}

/* What the ports that multiply can do at most: n times twelve independent fused multiply-adds. */
double multiply_adds(long n) {
    V a = splat(0), b = splat(1), c = splat(2), d = splat(3), e = splat(4), f = splat(5);
    V g = splat(6), h = splat(7), i = splat(8), j = splat(9), k = splat(10), l = splat(11);
    const V x = splat(0.999), y = splat(1e-3);
    for (long m = 0; m < n; m++) {
        a = a * x + y, b = b * x + y, c = c * x + y, d = d * x + y, e = e * x + y, f = f * x + y;
        g = g * x + y, h = h * x + y, i = i * x + y, j = j * x + y, k = k * x + y, l = l * x + y;
    }
    return (a + b + c + d + e + f + g + h + i + j + k + l)[0];
}
