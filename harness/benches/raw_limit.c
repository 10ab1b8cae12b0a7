/* The upper limit of the rate of collection: MuJoCo's mj_step and one rendering per sample, on all cores.
 *
 *     raw_limit MODEL.xml COURSES THREADS [--no-rendering]
 *
 * The example `courses` writes the file COURSES. Each thread has its own state and OpenGL context. It takes the next
 * episode and sets its controls step by step. After the first step of a sample it draws a frame of 64 x 64 pixels from
 * the camera `external`, and reads the pixels, because otherwise a software renderer need not draw them. Nothing is
 * sensed or kept. At the end of an episode, the positions must be those in COURSES, bit by bit.
 *
 * Prints JSON. `seconds` is the wall time from when all threads are ready. `physics_seconds` and `rendering_seconds`
 * are sums over the threads. compare.py compiles and runs this program.
 */

#include <dlfcn.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <mujoco/mujoco.h>

enum { SIDE = 64 };

/* The names of EGL that are needed. With them, its headers need not be installed. */
typedef void *EGLHandle;
enum {
  EGL_PBUFFER_BIT = 1,
  EGL_SURFACE_TYPE = 0x3033,
  EGL_NONE = 0x3038,
  EGL_RENDERABLE_TYPE = 0x3040,
  EGL_OPENGL_BIT = 8,
  EGL_HEIGHT = 0x3056,
  EGL_WIDTH = 0x3057,
  EGL_OPENGL_API = 0x30A2,
  EGL_PLATFORM_DEVICE_EXT = 0x313F,
};

typedef struct {
  int64_t episodes, samples, steps_per_sample, steps, coordinates, controls;
} Header;

static mjModel *model;
static Header header;
static double *courses;
static int is_rendering;
static int64_t next_episode;
static pthread_barrier_t ready;

typedef struct {
  double physics, rendering;
} Seconds;

static void fail(const char *what) {
  fprintf(stderr, "raw_limit: %s\n", what);
  exit(1);
}

static double now(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return time.tv_sec + 1e-9 * time.tv_nsec;
}

/* Creates an OpenGL context without a display on the first EGL device that has one, and makes it current. */
static void open_context(void) {
  void *library = dlopen("libEGL.so.1", RTLD_NOW);
  if (!library) fail("there is no libEGL.so.1");
  void *(*find)(const char *) = (void *(*)(const char *))dlsym(library, "eglGetProcAddress");
  unsigned (*query_devices)(int, EGLHandle *, int *) = find("eglQueryDevicesEXT");
  EGLHandle (*get_display)(unsigned, EGLHandle, const int *) = find("eglGetPlatformDisplayEXT");
  unsigned (*initialize)(EGLHandle, int *, int *) = find("eglInitialize");
  unsigned (*choose)(EGLHandle, const int *, EGLHandle *, int, int *) = find("eglChooseConfig");
  unsigned (*bind)(unsigned) = find("eglBindAPI");
  EGLHandle (*make_surface)(EGLHandle, EGLHandle, const int *) = find("eglCreatePbufferSurface");
  EGLHandle (*make_context)(EGLHandle, EGLHandle, EGLHandle, const int *) = find("eglCreateContext");
  unsigned (*make_current)(EGLHandle, EGLHandle, EGLHandle, EGLHandle) = find("eglMakeCurrent");
  if (!query_devices || !get_display) fail("EGL has no device platform");

  const int wanted[] = {EGL_SURFACE_TYPE, EGL_PBUFFER_BIT, EGL_RENDERABLE_TYPE, EGL_OPENGL_BIT, EGL_NONE};
  const int size[] = {EGL_WIDTH, SIDE, EGL_HEIGHT, SIDE, EGL_NONE};
  EGLHandle devices[16];
  int count = 0;
  query_devices(16, devices, &count);
  for (int device = 0; device < count; device++) {
    EGLHandle display = get_display(EGL_PLATFORM_DEVICE_EXT, devices[device], NULL), config;
    int configs = 0;
    if (!display || !initialize(display, NULL, NULL)) continue;
    if (!choose(display, wanted, &config, 1, &configs) || !configs || !bind(EGL_OPENGL_API)) continue;
    EGLHandle surface = make_surface(display, config, size);
    EGLHandle context = make_context(display, config, NULL, NULL);
    if (surface && context && make_current(display, surface, surface, context)) return;
  }
  fail("no EGL device offers an OpenGL context");
}

typedef struct {
  mjvCamera camera;
  mjvOption option;
  mjvScene scene;
  mjrContext context;
} View;

static View *open_view(void) {
  View *view = calloc(1, sizeof *view);
  open_context();
  mjv_defaultCamera(&view->camera);
  view->camera.type = mjCAMERA_FIXED;
  view->camera.fixedcamid = mj_name2id(model, mjOBJ_CAMERA, "external");
  mjv_defaultOption(&view->option);
  mjv_defaultScene(&view->scene);
  mjv_makeScene(model, &view->scene, 1000);
  mjr_defaultContext(&view->context);
  mjr_makeContext(model, &view->context, mjFONTSCALE_100);
  mjr_setBuffer(mjFB_OFFSCREEN, &view->context);
  return view;
}

static void draw(View *view, mjData *data) {
  static _Thread_local unsigned char pixels[SIDE * SIDE * 3];
  const mjrRect frame = {0, 0, SIDE, SIDE};
  mjv_updateScene(model, data, &view->option, NULL, &view->camera, mjCAT_ALL, &view->scene);
  mjr_render(frame, &view->scene, &view->context);
  mjr_readPixels(pixels, NULL, frame, &view->context);
}

static void simulate(const double *course, mjData *data, View *view, Seconds *spent) {
  const int64_t coordinates = header.coordinates;
  const double *last = course + coordinates, *controls = last + coordinates;
  mj_resetData(model, data);
  memcpy(data->qpos, course, coordinates * sizeof(double));
  double begin = now();
  for (int64_t step = 0; step < header.steps; step++) {
    memcpy(data->ctrl, controls + step * header.controls, header.controls * sizeof(double));
    if (step == header.steps - 1 && memcmp(data->qpos, last, coordinates * sizeof(double)))
      fail("the last positions are not those of the courses: another model or MuJoCo?");
    mj_step(model, data);
    if (view && step % header.steps_per_sample == 0) {
      const double stepped = now();
      draw(view, data);
      spent->physics += stepped - begin;
      begin = now();
      spent->rendering += begin - stepped;
    }
  }
  spent->physics += now() - begin;
}

static void *work(void *spent) {
  mjData *data = mj_makeData(model);
  View *view = is_rendering ? open_view() : NULL;
  pthread_barrier_wait(&ready);
  const int64_t course = header.coordinates * 2 + header.steps * header.controls;
  for (;;) {
    const int64_t episode = __atomic_fetch_add(&next_episode, 1, __ATOMIC_RELAXED);
    if (episode >= header.episodes) return NULL;
    simulate(courses + episode * course, data, view, spent);
  }
}

static void read_courses(const char *path) {
  FILE *file = fopen(path, "rb");
  if (!file || fread(&header, sizeof header, 1, file) != 1) fail("the courses can't be read");
  if (header.coordinates != model->nq || header.controls != model->nu) fail("the courses are not the model's");
  const size_t values = header.episodes * (header.coordinates * 2 + header.steps * header.controls);
  courses = malloc(values * sizeof(double));
  if (!courses || fread(courses, sizeof(double), values, file) != values) fail("the courses are cut short");
  fclose(file);
}

int main(int count, char **arguments) {
  enum { MAX_THREADS = 1024 };
  static pthread_t threads[MAX_THREADS];
  static Seconds spent[MAX_THREADS];
  char error[1000] = "";
  const int wanted = count >= 4 ? atoi(arguments[3]) : 0;
  if (wanted < 1 || wanted > MAX_THREADS) fail("usage: raw_limit MODEL.xml COURSES THREADS [--no-rendering]");
  is_rendering = count == 4;
  setenv("LP_NUM_THREADS", "0", 0);
  model = mj_loadXML(arguments[1], NULL, error, sizeof error);
  if (!model) fail(error);
  read_courses(arguments[2]);

  pthread_barrier_init(&ready, NULL, wanted + 1);
  for (int thread = 0; thread < wanted; thread++) pthread_create(&threads[thread], NULL, work, &spent[thread]);
  pthread_barrier_wait(&ready);
  const double begin = now();
  Seconds sum = {0, 0};
  for (int thread = 0; thread < wanted; thread++) {
    pthread_join(threads[thread], NULL);
    sum.physics += spent[thread].physics;
    sum.rendering += spent[thread].rendering;
  }
  const double seconds = now() - begin;
  const double samples = header.episodes * header.samples;
  printf("{\"seconds\": %.4f, \"samples\": %.0f, \"steps\": %lld, \"physics_seconds\": %.4f, "
         "\"rendering_seconds\": %.4f, \"samples_per_second\": %.2f, \"threads\": %d, \"mujoco\": \"%s\"}\n",
         seconds, samples, (long long)(header.episodes * header.steps), sum.physics, sum.rendering,
         samples / seconds, wanted, mj_versionString());
  return 0;
}
