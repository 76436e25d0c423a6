/*
 * Puts the solver into Bullet's table of virtual functions.
 *
 * Only a pointer in data is replaced: no code is changed, and nothing on disk. The
 * table lies in a page that the loader made read-only, so this page is writable for
 * the moment of the replacement.
 */
#if defined(__x86_64__) && defined(__linux__)
#define _GNU_SOURCE
#include "solver.h"

#include <stdint.h>
#include <sys/mman.h>
#include <unistd.h>

typedef double (*iterations_function)(struct solver *, struct collision_object **, int,
                                      void **, int, void **, int,
                                      const struct solver_info *, void *);

/* Who solves the groups of a thread. */
enum mode {
    FOLLOW, /* as all threads do */
    PROBE,  /* Bullet, and the layout is probed */
    SOLVE,  /* this solver */
    LEAVE,  /* Bullet */
};

/* Counts of a thread that is not in mode FOLLOW. */
struct counts {
    int solved;      /* groups that this solver solved */
    int left;        /* groups that it left to Bullet's function */
    int joint_rows;  /* rows of motors and limits that it saw */
    int contact_rows;
    int spinning_rows;
    const char *wrong; /* a field that is not laid out as declared */
};

static iterations_function bullet_iterations;
static void **iterations_slot;
static int enabled; /* for all threads in mode FOLLOW */
static __thread enum mode mode;
static __thread struct counts counts;
static __thread struct expectation expectation;

static double iterations(struct solver *solver, struct collision_object **bodies,
                         int num_bodies, void **manifolds, int num_manifolds,
                         void **constraints, int num_constraints,
                         const struct solver_info *info, void *drawer) {
    const enum mode own = mode;
    if (own == FOLLOW ? __atomic_load_n(&enabled, __ATOMIC_RELAXED) : own == SOLVE) {
        const int solved = solve_group(solver, bodies, num_bodies, num_manifolds,
                                       num_constraints, info);
        if (own == SOLVE) *(solved ? &counts.solved : &counts.left) += 1;
        if (solved) return 0.0;
    }
    if (own == PROBE && counts.wrong == NULL) {
        counts.wrong = probe_rows(solver, info, &expectation);
        if (counts.wrong == NULL) {
            counts.joint_rows += solver->multi_body_joint_rows.size;
            counts.contact_rows += solver->multi_body_normal_rows.size;
            counts.spinning_rows += solver->multi_body_spinning_rows.size;
        }
    }
    const double result =
        bullet_iterations(solver, bodies, num_bodies, manifolds, num_manifolds,
                          constraints, num_constraints, info, drawer);
    if (own == PROBE && counts.wrong == NULL)
        counts.wrong = probe_result(solver, bodies, num_bodies, num_manifolds, info);
    return result;
}

/* Stores a function in a slot of a table; returns 0, or 1 if the page is locked. */
static int store(void **slot, void *function) {
    const uintptr_t page_size = (uintptr_t)sysconf(_SC_PAGESIZE);
    void *page = (void *)((uintptr_t)slot & ~(page_size - 1));
    if (mprotect(page, page_size, PROT_READ | PROT_WRITE) != 0) return 1;
    __atomic_store_n(slot, function, __ATOMIC_RELEASE);
    mprotect(page, page_size, PROT_READ);
    return 0;
}

/* Replaces Bullet's function in a slot of a table; returns as `store` does. */
int solver_install(void **slot, iterations_function bullet) {
    bullet_iterations = bullet;
    iterations_slot = slot;
    return store(slot, (void *)iterations);
}

/* Puts Bullet's function back into its slot. */
int solver_uninstall(void) {
    return store(iterations_slot, (void *)bullet_iterations);
}

/* Switches all threads in mode FOLLOW to this solver, or to Bullet's function. */
void solver_enable(int on) { __atomic_store_n(&enabled, on, __ATOMIC_RELAXED); }

/* Sets the mode of the calling thread, and starts its counts. */
void solver_set_mode(enum mode new_mode, const struct expectation *expected) {
    mode = new_mode;
    counts = (struct counts){0};
    if (expected != NULL) expectation = *expected;
}

void solver_counts(struct counts *result) { *result = counts; }
#endif
