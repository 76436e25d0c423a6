/* Steps and resets many clients in threads of C, without Python.

   A free thread takes the next client. The caller's thread works too, and returns when
   all clients are done. */

#define _POSIX_C_SOURCE 200809L

#include "client.h"

#include <fenv.h>
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>

uint32_t loop_version(void) { return LOOP_VERSION; }

enum { STACK_SIZE = 8 << 20 }; /* of a thread, as on Linux; macOS has less by default */

typedef int work(struct batch *batch, int env);

struct loop {
    struct batch *batch;
    work *work; /* of the present call: on num_envs clients, whose indices are in envs */
    const int *envs;
    int num_envs;
    int num_taken, num_done; /* how many of them a thread has taken, and has done */

    pthread_mutex_t mutex; /* protects everything that changes */
    pthread_cond_t begun, done;
    int is_over;
    int num_workers; /* threads of the loop; the caller's thread is not counted */
    pthread_t workers[];
};

/* Work until every client is taken. The caller holds the mutex. */
static void take_clients(struct loop *loop) {
    while (loop->num_taken < loop->num_envs) {
        int env = loop->envs[loop->num_taken++];
        pthread_mutex_unlock(&loop->mutex);
        loop->work(loop->batch, env);
        pthread_mutex_lock(&loop->mutex);
        if (++loop->num_done == loop->num_envs) pthread_cond_signal(&loop->done);
    }
}

static void *serve(void *argument) {
    struct loop *loop = argument;
    fesetenv(FE_DFL_ENV); /* do not inherit floating-point settings of the creator */
    pthread_mutex_lock(&loop->mutex);
    while (!loop->is_over) {
        take_clients(loop);
        pthread_cond_wait(&loop->begun, &loop->mutex);
    }
    pthread_mutex_unlock(&loop->mutex);
    return NULL;
}

/* Start num_threads - 1 threads, because the caller's thread works too. */
struct loop *loop_create(struct batch *batch, int num_threads) {
    struct loop *loop = calloc(1, sizeof *loop + num_threads * sizeof(pthread_t));
    if (!loop) return NULL;
    loop->batch = batch;
    pthread_mutex_init(&loop->mutex, NULL);
    pthread_cond_init(&loop->begun, NULL);
    pthread_cond_init(&loop->done, NULL);
    pthread_attr_t attributes;
    pthread_attr_init(&attributes);
    pthread_attr_setstacksize(&attributes, STACK_SIZE);
    /* Block all signals in the new threads, so that Python's threads handle them. */
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    for (; loop->num_workers < num_threads - 1; loop->num_workers++) {
        pthread_t *worker = &loop->workers[loop->num_workers];
        if (pthread_create(worker, &attributes, serve, loop)) break;
    }
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    pthread_attr_destroy(&attributes);
    return loop;
}

/* Do some work on the num_envs clients whose indices are in envs, without duplicates.
   Return whether it failed for one of them, or the state of one is not finite. */
static int run(struct loop *loop, work *work, const int *envs, int num_envs) {
    fenv_t before; /* the caller's settings, which may flush denormals to zero */
    fegetenv(&before);
    fesetenv(FE_DFL_ENV);
    pthread_mutex_lock(&loop->mutex);
    loop->work = work, loop->envs = envs, loop->num_envs = num_envs;
    loop->num_taken = loop->num_done = 0;
    pthread_cond_broadcast(&loop->begun);
    take_clients(loop);
    while (loop->num_done < num_envs) pthread_cond_wait(&loop->done, &loop->mutex);
    pthread_mutex_unlock(&loop->mutex);
    fesetenv(&before);
    const struct batch *batch = loop->batch;
    for (int k = 0; k < num_envs; k++)
        if (batch->failures[envs[k]].expected || batch->clients[envs[k]]->has_diverged)
            return 1;
    return 0;
}

int loop_step(struct loop *loop, const int *envs, int num_envs) {
    return run(loop, client_step, envs, num_envs);
}

int loop_reset(struct loop *loop, const int *envs, int num_envs) {
    return run(loop, client_reset, envs, num_envs);
}

/* End the threads. A forked child has no threads and must not call this. */
void loop_destroy(struct loop *loop) {
    pthread_mutex_lock(&loop->mutex);
    loop->is_over = 1;
    pthread_cond_broadcast(&loop->begun);
    pthread_mutex_unlock(&loop->mutex);
    for (int k = 0; k < loop->num_workers; k++) pthread_join(loop->workers[k], NULL);
    pthread_mutex_destroy(&loop->mutex);
    pthread_cond_destroy(&loop->begun);
    pthread_cond_destroy(&loop->done);
    free(loop);
}
