/* Checks one function of refraction against this pack; replace `refract` with your own.

       cc -O2 -o check_rays programs/check_rays.c -lm
       ./check_rays rays/f64.csv rays/certified-f64.csv > answers.csv

   For single precision: cc -DREAL=float -DU=0x1p-24, and the files of f32. */
#include <stdio.h>
#include "judge.h"
#ifndef REAL
#define REAL double
#define U 0x1p-53
#endif

static int refract(const REAL *a, const REAL *n, REAL k, REAL *b) { /* returns 0 for total internal reflection */
    REAL c = a[0] * n[0] + a[1] * n[1] + a[2] * n[2], d = 1 - k * k * (1 - c * c);
    REAL f = k * c + (REAL)sqrt(d > 0 ? d : 0);
    for (int i = 0; i < 3; i++)
        b[i] = k * a[i] - f * n[i];
    return d >= 0;
}

static int row(FILE *file, double *numbers, int count) { /* reads the next row of numbers; returns 0 at the end */
    char line[1000];
    for (int used, read, at; fgets(line, sizeof line, file);) {
        for (used = read = 0; read < count && sscanf(line + used, "%lf%n", numbers + read, &at) == 1; read++)
            used += at + (line[used + at] == ',');
        if (read == count)
            return 1;
    }
    return 0;
}

int main(int count, char **names) {
    FILE *rays = count > 2 ? fopen(names[1], "r") : NULL, *certified = rays ? fopen(names[2], "r") : NULL;
    int verdicts[3] = {0};
    Ray ray;
    Certified exact;
    puts("id,bx,by,bz,transmitted");
    while (certified && row(rays, &ray.id, 9) && row(certified, &exact.id, 15) && exact.id == ray.id) {
        REAL a[3] = {ray.a[0], ray.a[1], ray.a[2]}, n[3] = {ray.n[0], ray.n[1], ray.n[2]}, b[3];
        int transmitted = refract(a, n, (REAL)ray.n_from / (REAL)ray.n_to, b);
        double answer[3] = {b[0], b[1], b[2]};
        verdicts[judge(&ray, &exact, answer, transmitted, U)]++;
        printf("%.0f,%.17g,%.17g,%.17g,%d\n", ray.id, answer[0], answer[1], answer[2], transmitted);
    }
    fprintf(stderr, "%d wrong, %d within the bound, %d right\n", verdicts[0], verdicts[1], verdicts[2]);
    int judged = verdicts[WITHIN_BOUND] + verdicts[RIGHT] > 0 && feof(rays) && !row(certified, &exact.id, 15);
    return verdicts[WRONG] > 0 || !judged;
}
