/* Judges answers to the rays of this pack as `mi-refract rays check` does. C99; link with -lm. */
#include <math.h>

typedef struct { double id, a[3], n[3], n_from, n_to; } Ray;            /* a row of rays/f32.csv, rays/f64.csv */
typedef struct {                                                       /* a row of rays/certified-….csv */
    double id, transmitted, b[3], b_low[3], cos_t;
    double angle_limit, length_limit, decided, plane_limit, radicand_limit, side_open;
} Certified;
typedef enum { WRONG, WITHIN_BOUND, RIGHT } Verdict;
typedef long double Real;                                               /* has a roundoff of 1e-19 if 80 bits wide */

static const double BACKWARD_LIMIT = 8;                                 /* in units of roundoff u */

static Real dot(const Real *p, const Real *q) { return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]; }

static Real cross(const Real *p, const Real *q, Real *r) {              /* r = p × q; returns |r| */
    for (int i = 0; i < 3; i++)
        r[i] = p[(i + 1) % 3] * q[(i + 2) % 3] - p[(i + 2) % 3] * q[(i + 1) % 3];
    return sqrtl(dot(r, r));
}

static Real unit(const double *v, Real *r) {                            /* r = v/|v|; returns |v| */
    Real wide[3] = {v[0], v[1], v[2]}, length = sqrtl(dot(wide, wide));
    for (int i = 0; i < 3; i++)
        r[i] = wide[i] / length;
    return length;
}

/* Returns the least relative change of a, n and k for which the answer is exact. All vectors are unit. */
static Real backward_error(const Real *a, const Real *n, Real k, const Real *b, int transmitted) {
    Real axis[3], w[3], defect[3];
    Real cosine = dot(a, n), sine = cross(n, a, axis), e = k * sine;
    if (!transmitted) {                                                 /* the change that makes the ray transmitted */
        Real step = fabsl(1 - e * e) / (2 * e * (2 * k * fabsl(cosine) + e));
        return fminl(step, fabsl(asinl(1 / k) - atan2l(sine, fabsl(cosine))) / 2);
    }
    for (int i = 0; i < 3; i++)
        w[i] = k * a[i] - b[i];                                         /* Snell's law: n × w = 0 */
    Real size = cross(n, w, defect), gamma = fabsl(dot(n, w));
    Real along = sine > 0 ? fabsl(dot(defect, axis)) / sine : 0, across = sqrtl(fmaxl(size * size - along * along, 0));
    Real worst = -dot(n, b) * ((cosine > 0) - (cosine < 0));            /* b on the wrong side: n must turn this far */
    for (int i = 0; i <= 32; i++) {
        Real turn = i * acosl(-1) / 64, x = cosl(turn), y = sinl(turn);
        worst = fmaxl(worst, (along * x + across * y) / (k * sqrtl(cosine * cosine * x * x + y * y) + gamma + e * x));
    }
    return worst;
}

/* Returns whether the textbook formula with rounding errors can give b; for rays with wide error bounds. */
static int possible(const Real *a, const Real *n, Real k, const Real *b, const Certified *limits) {
    Real t[3], rest[3], off[3], cosine = dot(a, n), sign = cosine < 0 ? -1 : 1, onward = sign * dot(b, n);
    for (int i = 0; i < 3; i++)
        t[i] = a[i] - cosine * n[i], rest[i] = b[i] - onward * sign * n[i];
    Real sine = sqrtl(dot(t, t)), e = k * sine, along = sine > 0 ? dot(rest, t) / sine : 0;
    for (int i = 0; i < 3; i++)
        off[i] = rest[i] - (sine > 0 ? along * t[i] / sine : 0);
    Real across = sqrtl(dot(off, off)), plane = along * along + across * across;
    Real root2 = limits->transmitted ? (Real)limits->cos_t * limits->cos_t : 1 - e * e;
    Real low = sqrtl(fmaxl(root2 - limits->radicand_limit, 0)), high = sqrtl(fmaxl(root2 + limits->radicand_limit, 0));
    onward = limits->side_open ? fabsl(onward) : onward;
    Real root = fminl(fmaxl(plane > 0 ? e * onward * along / plane : low, low), high);
    Real turned = e * onward - root * along;
    if (sqrtl(e * e + root * root) <= limits->plane_limit)
        return 1;
    Real error = sqrtl((root * root + e * e) * across * across + turned * turned);
    return error <= limits->plane_limit && e * along + root * onward > 0;
}

/* `b`, `transmitted`: the answer; b is ignored if not transmitted. `u`: 0x1p-24 for f32, 0x1p-53 for f64. */
static Verdict judge(const Ray *ray, const Certified *certified, const double *b, int transmitted, double u) {
    Real a[3], n[3], unit_b[3], exact[3], axis[3], k = (Real)ray->n_from / ray->n_to;
    Real of_a = unit(ray->a, a), length = unit(b, unit_b), off = fminl(fabsl(length - 1), fabsl(length / of_a - 1));
    Real of_square = fminl(fabsl(length * length - 1), fabsl(length * length / (of_a * of_a) - 1));
    unit(ray->n, n);
    if (transmitted && (!(length > 0 && length < HUGE_VAL) || !possible(a, n, k, unit_b, certified)))
        return WRONG;
    if (transmitted != certified->transmitted) {
        if (certified->decided)
            return WRONG;
    } else if (transmitted) {
        for (int i = 0; i < 3; i++)
            exact[i] = (Real)certified->b[i] + certified->b_low[i];
        Real angle = atan2l(cross(unit_b, exact, axis), dot(unit_b, exact));
        if (!(angle <= certified->angle_limit && off <= certified->length_limit))
            return WRONG;
    }
    if (!transmitted && !certified->transmitted)
        return RIGHT;
    if (transmitted && !(of_square / (4 * (2 * k + 1)) <= BACKWARD_LIMIT * u)) /* the backward error of the length */
        return WITHIN_BOUND;
    return backward_error(a, n, k, unit_b, transmitted) <= BACKWARD_LIMIT * u ? RIGHT : WITHIN_BOUND;
}
