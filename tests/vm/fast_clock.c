/* A faster clock for the processes that it is loaded into: every second of this computer counts as FAST_CLOCK seconds,
   for what reads the time, for what waits, and for the times of files written meanwhile. FAST_CLOCK_SINCE is a number of
   nanoseconds of CLOCK_MONOTONIC and one of CLOCK_REALTIME, from which on it does.

   libfaketime does not serve: it leaves Python's locks and Rust's futexes to the real clock. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdarg.h>
#include <stdlib.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

typedef int64_t ns;
#define SECOND 1000000000LL
#define SHORTEST 100000LL /* ns of a wait, or threads that wait for Python's lock would wake too often */

static ns monotonic, realtime, factor = 1;

__attribute__((constructor)) static void begin(void) {
  const char *factor_text = getenv("FAST_CLOCK"), *since = getenv("FAST_CLOCK_SINCE");
  long long m, r;
  if (factor_text && since && sscanf(since, "%lld %lld", &m, &r) == 2) {
    monotonic = m, realtime = r, factor = atoll(factor_text);
  }
}

static ns read_clock(clockid_t clock) {
  struct timespec t;
  syscall(SYS_clock_gettime, clock, &t);
  return t.tv_sec * SECOND + t.tv_nsec;
}
static ns of(const struct timespec *t) { return t->tv_sec * SECOND + t->tv_nsec; }
static struct timespec to(ns n) { return (struct timespec){n / SECOND, n % SECOND}; }
static ns start_of(clockid_t clock) {
  switch (clock) {
    case CLOCK_REALTIME: case CLOCK_REALTIME_COARSE: return realtime;
    case CLOCK_MONOTONIC: case CLOCK_MONOTONIC_COARSE: case CLOCK_MONOTONIC_RAW: case CLOCK_BOOTTIME: return monotonic;
    default: return -1;
  }
}
static ns faster(ns real, ns start) { return real <= start ? real : start + (real - start) * factor; }
static ns shorter(ns duration) {
  ns scaled = duration / factor;
  return duration <= 0 ? duration : scaled < SHORTEST ? SHORTEST : scaled;
}
/* An absolute time of the faster clock, as one of the real clock. */
static struct timespec deadline(const struct timespec *t, clockid_t clock) {
  ns start = start_of(clock), now = faster(read_clock(clock), start);
  return to(read_clock(clock) + shorter(of(t) - now));
}
static clockid_t clock_of(const struct timespec *t) {
  return t->tv_sec > 1000000000 ? CLOCK_REALTIME : CLOCK_MONOTONIC;
}
#define REAL(name) ((typeof(&name))(dlsym(RTLD_NEXT, #name)))

int clock_gettime(clockid_t clock, struct timespec *t) {
  int code = syscall(SYS_clock_gettime, clock, t);
  ns start = start_of(clock);
  if (code == 0 && start >= 0) *t = to(faster(of(t), start));
  return code;
}
time_t time(time_t *t) {
  time_t now = faster(read_clock(CLOCK_REALTIME), realtime) / SECOND;
  if (t) *t = now;
  return now;
}
int gettimeofday(struct timeval *restrict t, void *restrict zone) {
  (void)zone;
  ns now = faster(read_clock(CLOCK_REALTIME), realtime);
  *t = (struct timeval){now / SECOND, now % SECOND / 1000};
  return 0;
}
int clock_nanosleep(clockid_t clock, int flags, const struct timespec *t, struct timespec *left) {
  struct timespec real = flags & TIMER_ABSTIME ? deadline(t, clock) : to(shorter(of(t)));
  (void)left;
  return syscall(SYS_clock_nanosleep, clock, flags, &real, NULL) == 0 ? 0 : errno;
}
int nanosleep(const struct timespec *t, struct timespec *left) {
  int code = clock_nanosleep(CLOCK_MONOTONIC, 0, t, left);
  return code ? (errno = code, -1) : 0;
}
int usleep(useconds_t us) {
  struct timespec t = to(us * 1000LL);
  return nanosleep(&t, NULL);
}
int ppoll(struct pollfd *fds, nfds_t count, const struct timespec *t, const sigset_t *mask) {
  struct timespec real;
  if (t) real = to(shorter(of(t)));
  return REAL(ppoll)(fds, count, t ? &real : NULL, mask);
}
int poll(struct pollfd *fds, nfds_t count, int ms) {
  struct timespec t = to(ms * 1000000LL);
  return ppoll(fds, count, ms < 0 ? NULL : &t, NULL);
}
int epoll_pwait2(int fd, struct epoll_event *events, int most, const struct timespec *t, const sigset_t *mask) {
  struct timespec real;
  if (t) real = to(shorter(of(t)));
  return syscall(SYS_epoll_pwait2, fd, events, most, t ? &real : NULL, mask, 8);
}
int epoll_wait(int fd, struct epoll_event *events, int most, int ms) {
  struct timespec t = to(ms * 1000000LL);
  return epoll_pwait2(fd, events, most, ms < 0 ? NULL : &t, NULL);
}
int epoll_pwait(int fd, struct epoll_event *events, int most, int ms, const sigset_t *mask) {
  struct timespec t = to(ms * 1000000LL);
  return epoll_pwait2(fd, events, most, ms < 0 ? NULL : &t, mask);
}
int select(int n, fd_set *r, fd_set *w, fd_set *e, struct timeval *t) {
  struct timeval real;
  if (t) {
    ns wait = shorter(t->tv_sec * SECOND + t->tv_usec * 1000);
    real = (struct timeval){wait / SECOND, wait % SECOND / 1000};
  }
  return REAL(select)(n, r, w, e, t ? &real : NULL);
}
int sem_clockwait(sem_t *s, clockid_t clock, const struct timespec *t) {
  struct timespec real = deadline(t, clock);
  return REAL(sem_clockwait)(s, clock, &real);
}
int sem_timedwait(sem_t *s, const struct timespec *t) {
  struct timespec real = deadline(t, CLOCK_REALTIME);
  return REAL(sem_timedwait)(s, &real);
}
int pthread_cond_timedwait(pthread_cond_t *c, pthread_mutex_t *m, const struct timespec *t) {
  struct timespec real = deadline(t, clock_of(t));
  return ((typeof(&pthread_cond_timedwait))dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2"))(c, m, &real);
}
int pthread_cond_clockwait(pthread_cond_t *c, pthread_mutex_t *m, clockid_t clock, const struct timespec *t) {
  struct timespec real = deadline(t, clock);
  return REAL(pthread_cond_clockwait)(c, m, clock, &real);
}
/* Rust waits so: FUTEX_WAIT_BITSET until an absolute time, others for a duration. */
long syscall(long number, ...) {
  va_list list;
  long a[6];
  va_start(list, number);
  for (int i = 0; i < 6; i++) a[i] = va_arg(list, long);
  va_end(list);
  struct timespec real;
  if (number == SYS_futex && a[3]) {
    int operation = a[1] & FUTEX_CMD_MASK;
    const struct timespec *t = (const struct timespec *)a[3];
    if (operation == FUTEX_WAIT_BITSET) {
      real = deadline(t, a[1] & FUTEX_CLOCK_REALTIME ? CLOCK_REALTIME : CLOCK_MONOTONIC);
      a[3] = (long)&real;
    } else if (operation == FUTEX_WAIT) {
      real = to(shorter(of(t)));
      a[3] = (long)&real;
    }
  }
  long result;
  register long r10 __asm__("r10") = a[3], r8 __asm__("r8") = a[4], r9 __asm__("r9") = a[5];
  __asm__ volatile("syscall" : "=a"(result) : "a"(number), "D"(a[0]), "S"(a[1]), "d"(a[2]), "r"(r10), "r"(r8), "r"(r9)
                   : "rcx", "r11", "memory");
  if (result < 0 && result > -4096) return errno = -result, -1;
  return result;
}
static int dated(int code, struct stat *s) {
  if (code == 0) {
    s->st_mtim = to(faster(of(&s->st_mtim), realtime));
    s->st_ctim = to(faster(of(&s->st_ctim), realtime));
    s->st_atim = to(faster(of(&s->st_atim), realtime));
  }
  return code;
}
int stat(const char *restrict path, struct stat *restrict s) { return dated(REAL(stat)(path, s), s); }
int lstat(const char *restrict path, struct stat *restrict s) { return dated(REAL(lstat)(path, s), s); }
int fstat(int fd, struct stat *s) { return dated(REAL(fstat)(fd, s), s); }
int fstatat(int fd, const char *restrict path, struct stat *restrict s, int flags) {
  return dated(REAL(fstatat)(fd, path, s, flags), s);
}
int stat64(const char *restrict path, struct stat64 *restrict s) { return stat(path, (struct stat *)s); }
int lstat64(const char *restrict path, struct stat64 *restrict s) { return lstat(path, (struct stat *)s); }
int fstat64(int fd, struct stat64 *s) { return fstat(fd, (struct stat *)s); }
int fstatat64(int fd, const char *restrict path, struct stat64 *restrict s, int flags) {
  return fstatat(fd, path, (struct stat *)s, flags);
}
