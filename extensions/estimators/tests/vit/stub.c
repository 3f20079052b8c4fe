/* A library with Monado's VIT interface, for tests: it counts on its IMU alone, from rest on.

   The words of its configuration file say what it does: "delay 20" (ms to each pose), "starts 4"
   (no pose for the first 4 frames), "crash 9", "nan 9", "skips 9" (no pose for that frame),
   "stops 9", "log FILE" (where it writes what it was told), "reads FILE" (that must be there). */
#include <math.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

typedef struct { const char *file; uint32_t cameras, imus; bool show_ui; } config;
typedef struct { int64_t stamp; float ax, ay, az, wx, wy, wz; } imu_sample;
typedef struct {
    uint32_t camera; int64_t stamp; uint8_t *data; uint32_t width, height, stride, size;
    int format; uint32_t mask_count; void *masks;
} image_sample;
typedef struct { int64_t stamp; float p[3], q[4], v[3]; } pose_data;
typedef struct {
    uint32_t camera; int width, height; double rate, fx, fy, cx, cy; int model;
    uint32_t count; double distortion[32], transform[16];
} camera_calibration;
typedef struct { double transform[9], offset[3], bias[3], noise[3]; } inertial_calibration;
typedef struct { uint32_t imu; double rate; inertial_calibration accel, gyro; } imu_calibration;
typedef struct { pose_data data; double ready; } pose;
typedef struct {
    uint32_t cameras, next; int frames, delay, starts, crash, nan, skips, stops;
    bool running; FILE *log; int64_t imu, image, first;
    double r[9], p[3], v[3]; pose queue[4096]; int in, out;
} tracker;

static int major = 2;
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec * 1e-9;
}
static void rest(tracker *t) { /* level, front-right-down, in a world whose z is up */
    double level[9] = {1, 0, 0, 0, -1, 0, 0, 0, -1};
    memcpy(t->r, level, sizeof level);
    memset(t->p, 0, sizeof t->p);
    memset(t->v, 0, sizeof t->v);
}
int vit_api_get_version(uint32_t *a, uint32_t *b, uint32_t *c) {
    *a = getenv("STUB_VERSION") ? atoi(getenv("STUB_VERSION")) : major, *b = 0, *c = 1;
    return 0;
}
int vit_tracker_create(const config *c, tracker **out) {
    char word[4096];
    tracker *t = calloc(1, sizeof *t);
    t->cameras = c->cameras;
    t->imu = t->image = -1;
    t->crash = t->nan = t->skips = t->stops = -1;
    FILE *f = c->file ? fopen(c->file, "r") : NULL;
    if (c->file && !f) return -2;
    while (f && fscanf(f, "%4095s", word) == 1) {
        char value[4096] = "";
        if (fscanf(f, "%4095s", value) != 1) return -2;
        if (!strcmp(word, "delay")) t->delay = atoi(value);
        else if (!strcmp(word, "starts")) t->starts = atoi(value);
        else if (!strcmp(word, "crash")) t->crash = atoi(value);
        else if (!strcmp(word, "nan")) t->nan = atoi(value);
        else if (!strcmp(word, "skips")) t->skips = atoi(value);
        else if (!strcmp(word, "stops")) t->stops = atoi(value);
        else if (!strcmp(word, "log")) t->log = fopen(value, "w");
        else if (!strcmp(word, "reads")) { /* a file of the calibration: is it there? */
            FILE *g = fopen(value, "r");
            if (!g) return -2;
            fclose(g);
        } else return -2;
    }
    if (f) fclose(f);
    rest(t);
    *out = t;
    return 0;
}
void vit_tracker_destroy(tracker *t) {
    if (t->log) fprintf(t->log, "destroyed\n"), fclose(t->log);
    free(t);
}
int vit_tracker_start(tracker *t) { t->running = true; return 0; }
int vit_tracker_stop(tracker *t) { t->running = false; return 0; }
int vit_tracker_reset(tracker *t) { rest(t); return 0; }
int vit_tracker_is_running(const tracker *t, bool *out) { *out = t->running; return 0; }
int vit_tracker_add_camera_calibration(tracker *t, const camera_calibration *c) {
    if (t->running || c->camera != t->next++) return -2;
    if (t->next == t->cameras) t->next = 0;
    if (!t->log) return 0;
    fprintf(t->log, "camera %d %d %g %g %g %g %g", c->width, c->height, c->rate, c->fx, c->fy,
            c->cx, c->cy);
    fprintf(t->log, " model %d", c->model);
    for (uint32_t i = 0; i < c->count; i++) fprintf(t->log, " %g", c->distortion[i]);
    fprintf(t->log, " at");
    for (int i = 0; i < 3; i++) fprintf(t->log, " %g", c->transform[4 * i + 3]);
    fprintf(t->log, "\n");
    return 0;
}
int vit_tracker_add_imu_calibration(tracker *t, const imu_calibration *c) {
    if (t->running) return -2;
    if (t->log)
        fprintf(t->log, "imu %g %g %g %g %g %g\n", c->rate, c->gyro.noise[0], c->gyro.bias[1],
                c->accel.noise[2], c->accel.bias[0], c->accel.transform[0]);
    return 0;
}
int vit_tracker_push_imu_sample(tracker *t, const imu_sample *s) {
    if (s->stamp <= t->imu) return -2;
    double dt = t->imu < 0 ? 0 : (s->stamp - t->imu) * 1e-9, w[3] = {s->wx, s->wy, s->wz};
    double a[3] = {s->ax, s->ay, s->az}, *r = t->r, old[9];
    t->imu = s->stamp;
    double angle = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) * dt;
    if (angle > 1e-12) { /* Rodrigues */
        double k[3], m[9], c = cos(angle), n = sin(angle);
        for (int i = 0; i < 3; i++) k[i] = w[i] * dt / angle;
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) m[3 * i + j] = (i == j) * c + (1 - c) * k[i] * k[j];
        m[1] -= n * k[2], m[2] += n * k[1], m[3] += n * k[2];
        m[5] -= n * k[0], m[6] -= n * k[1], m[7] += n * k[0];
        memcpy(old, r, sizeof old);
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) {
                r[3 * i + j] = 0;
                for (int l = 0; l < 3; l++) r[3 * i + j] += old[3 * i + l] * m[3 * l + j];
            }
    }
    for (int i = 0; i < 3; i++) {
        double g = r[3 * i] * a[0] + r[3 * i + 1] * a[1] + r[3 * i + 2] * a[2];
        if (i == 2) g -= 9.81;
        t->p[i] += t->v[i] * dt + g * dt * dt / 2;
        t->v[i] += g * dt;
    }
    return 0;
}
int vit_tracker_push_img_sample(tracker *t, const image_sample *s) {
    if (!t->running || s->format != 1 || s->camera != t->next || s->size != s->stride * s->height)
        return -2;
    if (s->camera ? s->stamp != t->image : s->stamp <= t->image) return -2;
    if (t->imu <= s->stamp) return -2; /* Basalt would wait for a sample of after it */
    t->image = s->stamp;
    if (++t->next < t->cameras) return 0;
    t->next = 0;
    int n = t->frames++;
    if (n == t->crash) raise(SIGSEGV);
    if (n == t->stops) t->running = false;
    if (n < t->starts || n == t->skips) return 0;
    pose *p = &t->queue[t->in++ % 4096];
    double *r = t->r, w = sqrt(fmax(0, 1 + r[0] + r[4] + r[8])) / 2;
    double x = copysign(sqrt(fmax(0, 1 + r[0] - r[4] - r[8])) / 2, r[7] - r[5]);
    double y = copysign(sqrt(fmax(0, 1 - r[0] + r[4] - r[8])) / 2, r[2] - r[6]);
    double z = copysign(sqrt(fmax(0, 1 - r[0] - r[4] + r[8])) / 2, r[3] - r[1]);
    p->data = (pose_data){s->stamp, {t->p[0], t->p[1], t->p[2]}, {x, y, z, w},
                          {t->v[0], t->v[1], t->v[2]}};
    if (n == t->nan) p->data.p[1] = NAN;
    p->ready = now() + t->delay * 1e-3;
    return 0;
}
int vit_tracker_pop_pose(tracker *t, pose **out) {
    *out = NULL;
    if (t->out < t->in && t->queue[t->out % 4096].ready <= now()) {
        *out = malloc(sizeof **out);
        **out = t->queue[t->out++ % 4096];
    }
    return 0;
}
void vit_pose_destroy(pose *p) { free(p); }
int vit_pose_get_data(const pose *p, pose_data *out) { *out = p->data; return 0; }
