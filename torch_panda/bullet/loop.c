/* Steps and resets many clients in threads of C, without Python.

   A free thread takes the next client from a queue. The caller's thread takes part and
   returns when all clients are done.

   The steps of the last clients in the queue are cut into pieces of a few substeps. A
   thread does one piece and puts the client back into the queue, so that all threads
   finish at about the same time. Ideally, two threads need half of the sum of all
   clients' times. Measured with four clients, whose steps take 0.6 to 1.0 ms each, two
   threads need 8 % more than this with whole steps, and 4 % more with pieces. */

#define _POSIX_C_SOURCE 200809L

#include "client.h"

#include <fenv.h>
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>

int loop_version(void) { return LOOP_VERSION; }

enum {
    STACK_SIZE = 8 << 20, /* of a thread, as on Linux; the default of macOS is less */
    PIECE = 5 /* substeps; with shorter pieces, clients change threads more often, and
                 the caches have to load them again */
};

/* Do up to `piece` substeps of a client's work; return 1 if work remains, else 0. */
typedef int work(struct batch *batch, int env, int piece);

struct loop {
    struct batch *batch;
    work *work;
    int num_envs; /* clients of the present call */
    int num_done, num_failed;
    int *queue; /* ring buffer of the clients that wait for a thread */
    int first, num_waiting;
    int num_whole; /* the steps of the next num_whole clients are not cut */

    pthread_mutex_t mutex; /* protects everything that changes */
    pthread_cond_t begun, done;
    int is_over;
    int num_workers; /* threads of the loop; the caller's thread is not counted */
    pthread_t workers[];
};

/* Work on clients until the queue is empty. The caller holds the mutex. */
static void take_part(struct loop *loop) {
    while (loop->num_waiting) {
        int env = loop->queue[loop->first];
        int piece = loop->num_whole-- > 0 ? loop->batch->scene->num_substeps : PIECE;
        loop->first = (loop->first + 1) % loop->num_envs;
        loop->num_waiting--;
        pthread_mutex_unlock(&loop->mutex);
        int has_more = loop->work(loop->batch, env, piece);
        pthread_mutex_lock(&loop->mutex);
        if (has_more) {
            int last = (loop->first + loop->num_waiting++) % loop->num_envs;
            loop->queue[last] = env;
            continue;
        }
        loop->num_failed += loop->batch->failures[env].expected != 0;
        if (++loop->num_done == loop->num_envs) pthread_cond_signal(&loop->done);
    }
}

static void *serve(void *argument) {
    struct loop *loop = argument;
    fesetenv(FE_DFL_ENV); /* do not inherit floating-point settings of the creator */
    pthread_mutex_lock(&loop->mutex);
    while (!loop->is_over) {
        take_part(loop);
        pthread_cond_wait(&loop->begun, &loop->mutex);
    }
    pthread_mutex_unlock(&loop->mutex);
    return NULL;
}

/* Start num_threads - 1 threads, because the caller's thread takes part in the work.
   Start fewer if the system allows no more. Return NULL if there is no memory. The batch,
   and the memory that it points to, must outlive the loop. */
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

/* Do the work of the num_envs clients whose indices are in envs. Cut the steps of all
   but the first num_whole clients into pieces. Return the number of failures. envs
   becomes the queue: a client of which one piece was done is written back into it. */
static int share_out(struct loop *loop, work *work, int *envs, int num_envs,
                     int num_whole) {
    fenv_t before; /* the caller's settings, which may flush denormals to zero */
    fegetenv(&before);
    fesetenv(FE_DFL_ENV);
    pthread_mutex_lock(&loop->mutex);
    loop->work = work;
    loop->queue = envs, loop->num_envs = loop->num_waiting = num_envs;
    loop->num_whole = num_whole;
    loop->first = loop->num_done = loop->num_failed = 0;
    pthread_cond_broadcast(&loop->begun);
    take_part(loop);
    while (loop->num_done < num_envs) pthread_cond_wait(&loop->done, &loop->mutex);
    pthread_mutex_unlock(&loop->mutex);
    fesetenv(&before);
    return loop->num_failed;
}

/* Step the num_envs clients whose indices are in envs, without duplicates. Return the
   number of failures. The call overwrites envs. */
int loop_step(struct loop *loop, const struct control *control, doubles setpoint,
              int *envs, int num_envs) {
    struct batch *batch = loop->batch;
    batch->control = control, batch->setpoint = setpoint;
    for (int k = 0; k < num_envs; k++) batch->clients[envs[k]]->num_substeps = 0;
    /* Cutting more than the last two clients per thread costs more than it gains. */
    int num_cut = loop->num_workers ? 2 * (loop->num_workers + 1) : 0;
    return share_out(loop, client_take_piece, envs, num_envs, num_envs - num_cut);
}

static int reset(struct batch *batch, int env, int piece) {
    (void)piece;
    client_reset(batch, env);
    return 0;
}

/* Reset the num_envs clients whose indices are in envs. Return the number of
   failures. */
int loop_reset(struct loop *loop, int *envs, int num_envs) {
    return share_out(loop, reset, envs, num_envs, num_envs);
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
