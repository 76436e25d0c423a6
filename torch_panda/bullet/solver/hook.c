/*
 * Replaces functions in Bullet's tables of virtual functions (vtables).
 *
 * It replaces pointers in memory. It changes no machine code and no file. The loader made
 * the pages of the vtables read-only, so `store` makes a page writable for a moment.
 *
 * Functions that are not replaced
 * -------------------------------
 * The percentages are shares of the time of a step of 16 Push environments with all
 * replacements, measured with perf. The share of a function includes the functions that
 * it calls.
 *
 * AABBs of shapes, 2 %: spread over the classes of shapes.
 *
 * Contacts of two shapes (the narrow phase), 7 %: spread over many functions.
 */
#if defined(__x86_64__) && defined(__linux__)
#define _GNU_SOURCE
#include "solver.h"

#include <stdint.h>
#include <sys/mman.h>
#include <unistd.h>

enum { VERSION = 8 }; /* native.py refuses a library of another version */

/* The functions that are replaced, in the order of compat.py. */
enum { ITERATIONS, CONVERT, MOTOR_ROWS, LIMIT_ROWS, EXTERNAL_FORCES,
       COMMAND, UPDATE_AABBS, SET_AABB, SERIALIZE_BODIES, NUM_FUNCTIONS };

enum { MAX_BODIES = 16 }; /* of a world; Bullet accelerates further bodies */

/* btSequentialImpulseConstraintSolver::solveGroupCacheFriendlyIterations */
typedef double iterations_function(struct solver *, struct collision_object **, int,
                                   void **, int, void **, int,
                                   const struct solver_info *, void *);
/* btMultiBodyConstraintSolver::convertContacts */
typedef void convert_function(struct solver *, struct manifold **, int,
                              const struct solver_info *);
/* btMultiBodyConstraint::createConstraintRows */
typedef void rows_function(void *, struct array *, struct jacobian_data *,
                           const struct solver_info *);

/* btMultiBodyDynamicsWorld::solveExternalForces */
typedef void forces_function(struct world *, const struct solver_info *);

/* PhysicsServerCommandProcessor::processCommand */
typedef char command_function(struct server *, const struct command *, struct status *,
                              char *, int);
/* btCollisionWorld::updateAabbs */
typedef void update_function(struct world *);

/* btDbvtBroadphase::setAabb */
typedef void aabb_function(struct broad_phase *, struct proxy *, const struct vector3 *,
                           const struct vector3 *, void *);

/* btMultiBodyDynamicsWorld::serializeMultiBodies */
typedef void serialize_function(struct world *, void *);

/* Whether a thread runs Bullet's functions or the replacements. */
enum mode {
    FOLLOW, /* the ones that solver_enable chose for the whole process */
    PROBE,  /* Bullet's, while the layout of Bullet's structs is checked */
    SOLVE,  /* the replacements */
    LEAVE,  /* Bullet's */
};

/* Counts of a thread that is not in mode FOLLOW. */
struct counts {
    int groups;           /* that this solver solved */
    int bullet_groups;    /* that Bullet's function solved instead */
    int joints;           /* motors and limits whose rows this solver created */
    int bullet_joints;    /* motors and limits whose rows Bullet created instead */
    int manifolds;        /* whose rows this solver created */
    int bullet_manifolds; /* whose rows Bullet created instead */
    int bodies;           /* that `accelerate` accelerated */
    int bullet_bodies;    /* that Bullet accelerated instead */
    int answers;          /* for inverse kinematics, by this solver */
    int bullet_answers;   /* for inverse kinematics, by Bullet */
    int aabbs;            /* that `move_aabb` moved */
    int bullet_aabbs;     /* that Bullet moved instead */
    int snapshots;        /* without shapes */
    int bullet_snapshots; /* with shapes */
    int joint_rows;       /* that were probed */
    int contact_rows;     /* that were probed */
    int spinning_rows;    /* that were probed */
    const char *mismatch; /* a field that is not laid out as declared */
};

static void *bullet[NUM_FUNCTIONS];
static void **slots[NUM_FUNCTIONS];
static int enabled; /* whether threads in mode FOLLOW use this solver */
static __thread enum mode mode;
static __thread struct counts counts;
static __thread struct expectation expectation;
static __thread const struct world *probed_world; /* the latest, or NULL */
/* The responses of a group while `convert` lets Bullet create the rows of its joints in
   this thread, and NULL at all other times. */
static __thread struct responses **responses;

/* The AABBs of a world while Bullet updates them in this thread, otherwise NULL. */
static __thread struct aabbs *aabbs;

/* A world whose objects serialize_bodies has hidden, and the number of these objects. The
   world is NULL if no objects are hidden. */
struct snapshot {
    struct world *world;
    int num_objects;
};

/* While Bullet takes a snapshot in this thread, serialize_bodies stores the hidden objects
   here. At all other times, the pointer is NULL. */
static __thread struct snapshot *snapshot;

static int is_active(void) {
    const enum mode own = mode;
    return own == FOLLOW ? __atomic_load_n(&enabled, __ATOMIC_RELAXED) : own == SOLVE;
}

static double iterations(struct solver *solver, struct collision_object **bodies,
                         int num_bodies, void **manifolds, int num_manifolds,
                         void **constraints, int num_constraints,
                         const struct solver_info *info, void *drawer) {
    const enum mode own = mode;
    if (is_active()) {
        const int solved = solve_group(solver, bodies, num_bodies, num_manifolds,
                                       num_constraints, info);
        if (own == SOLVE) *(solved ? &counts.groups : &counts.bullet_groups) += 1;
        if (solved) return 0.0;
    }
    if (own == PROBE && counts.mismatch == NULL) {
        counts.mismatch = probe_rows(solver, info, &expectation);
        if (counts.mismatch == NULL) {
            counts.joint_rows += solver->multi_body_joint_rows.size;
            counts.contact_rows += solver->multi_body_normal_rows.size;
            counts.spinning_rows += solver->multi_body_spinning_rows.size;
        }
    }
    const double result = ((iterations_function *)bullet[ITERATIONS])(
        solver, bodies, num_bodies, manifolds, num_manifolds, constraints,
        num_constraints, info, drawer);
    if (own == PROBE && counts.mismatch == NULL)
        counts.mismatch = probe_result(solver, bodies, num_bodies, num_manifolds, info);
    return result;
}

/*
 * Creates the rows of a group: first those of contacts, then those of joints.
 *
 * Bullet's function creates both in one call. Here, convert_manifold creates the rows of
 * contacts. For each manifold that it refuses, Bullet's function is called with this
 * manifold alone and without joints. A last call, with the joints and without manifolds,
 * makes Bullet call motor_rows and limit_rows below for each joint. These two get the
 * responses of the bodies from the variable `responses`.
 */
static void convert(struct solver *solver, struct manifold **manifolds,
                    int num_manifolds, const struct solver_info *info) {
    convert_function *bullet_convert = (convert_function *)bullet[CONVERT];
    if (mode == PROBE && counts.mismatch == NULL)
        counts.mismatch =
            probe_manifolds(solver, manifolds, num_manifolds, info, &expectation);
    if (!is_active()) {
        bullet_convert(solver, manifolds, num_manifolds, info);
        return;
    }
    struct responses *list = NULL;
    const int num_constraints = solver->num_constraints;
    solver->num_constraints = 0;
    for (int i = 0; i < num_manifolds; i++) {
        const int converted = convert_manifold(&list, solver, manifolds[i], info);
        if (mode == SOLVE)
            *(converted ? &counts.manifolds : &counts.bullet_manifolds) += 1;
        if (!converted) bullet_convert(solver, manifolds + i, 1, info);
    }
    solver->num_constraints = num_constraints;
    responses = &list;
    bullet_convert(solver, manifolds, 0, info);
    responses = NULL;
    free_responses(list);
}

static void motor_rows(void *motor, struct array *rows, struct jacobian_data *data,
                       const struct solver_info *info) {
    struct responses **shared = responses;
    if (shared != NULL) {
        const int created = create_motor_rows(shared, motor, rows, data, info);
        if (mode == SOLVE) *(created ? &counts.joints : &counts.bullet_joints) += 1;
        if (created) return;
    }
    ((rows_function *)bullet[MOTOR_ROWS])(motor, rows, data, info);
}

static void limit_rows(void *limit, struct array *rows, struct jacobian_data *data,
                       const struct solver_info *info) {
    struct responses **shared = responses;
    if (shared != NULL) {
        const int created = create_limit_rows(shared, limit, rows, data, info);
        if (mode == SOLVE) *(created ? &counts.joints : &counts.bullet_joints) += 1;
        if (created) return;
    }
    ((rows_function *)bullet[LIMIT_ROWS])(limit, rows, data, info);
}

/*
 * Marks as asleep all bodies that `accelerate` can handle.
 *
 * Returns their number. Stores the bodies in `sleepers`, and their previous activation
 * states in `states`.
 */
static int put_to_sleep(const struct world *world, struct multi_body **sleepers,
                        int *states) {
    struct multi_body *const *bodies = world->bodies.data;
    int count = 0;
    for (int i = 0; i < world->bodies.size && count < MAX_BODIES; i++) {
        if (!can_accelerate(bodies[i])) continue;
        sleepers[count] = bodies[i];
        states[count++] = bodies[i]->base_collider->activation_state;
        bodies[i]->base_collider->activation_state = ASLEEP;
    }
    return count;
}

/*
 * Accelerates all bodies by the forces on them.
 *
 * Bullet's function prepares the step and then accelerates all bodies that are awake.
 * The bodies that `accelerate` can accelerate are therefore marked as asleep during the
 * call.
 */
static void external_forces(struct world *world, const struct solver_info *info) {
    forces_function *bullet_forces = (forces_function *)bullet[EXTERNAL_FORCES];
    struct multi_body *sleepers[MAX_BODIES];
    int states[MAX_BODIES];
    if (mode == PROBE && counts.mismatch == NULL) {
        counts.mismatch = probe_world(world, info, &expectation);
        probed_world = counts.mismatch == NULL ? world : NULL;
    }
    const int count = is_active() ? put_to_sleep(world, sleepers, states) : 0;
    bullet_forces(world, info);
    for (int i = 0; i < count; i++)
        sleepers[i]->base_collider->activation_state = states[i];
    for (int i = 0; i < count; i++) {
        const int accelerated = accelerate(sleepers[i], info->time_step);
        if (mode == SOLVE) *(accelerated ? &counts.bodies : &counts.bullet_bodies) += 1;
        if (accelerated) continue;
        /* Bullet's function does it, in a world of this body alone. */
        const struct array bodies = world->bodies;
        world->bodies = (struct array){.size = 1, .capacity = 1, .data = &sleepers[i]};
        bullet_forces(world, info);
        world->bodies = bodies;
    }
}

/*
 * Answers a command of a client.
 *
 * Bullet calls its function for the inverse kinematics directly, so no vtable has a slot
 * for it. All commands pass through this function, which has one.
 */
static char process_command(struct server *server, const struct command *command,
                            struct status *status, char *buffer, int buffer_size) {
    const int is_known = command->type == CALCULATE_INVERSE_KINEMATICS;
    if (is_known && is_active()) {
        const int answered = solve_inverse_kinematics(server, command, status);
        if (mode == SOLVE) *(answered ? &counts.answers : &counts.bullet_answers) += 1;
        if (answered) return 1;
    }
    struct snapshot taken = {NULL, 0};
    if (command->type == SAVE_STATE && is_active()) snapshot = &taken;
    const char has_status = ((command_function *)bullet[COMMAND])(
        server, command, status, buffer, buffer_size);
    snapshot = NULL;
    if (taken.world != NULL) taken.world->objects.size = taken.num_objects;
    if (is_known && mode == PROBE && counts.mismatch == NULL)
        counts.mismatch =
            probe_command(server, command, status, probed_world, &expectation);
    return has_status;
}

/* Updates the AABBs of all objects of a world. Bullet's function computes them and calls
   set_aabb for each. */
static void update_aabbs(struct world *world) {
    update_function *bullet_update = (update_function *)bullet[UPDATE_AABBS];
    if (!is_active() || world->objects.size > MAX_OBJECTS) {
        bullet_update(world);
        return;
    }
    struct aabbs list; /* its arrays stay uninitialised, to save time */
    list.world = world;
    list.num_objects = list.num_pairs = list.num_moved = list.num_left = 0;
    aabbs = &list;
    bullet_update(world);
    aabbs = NULL;
    if (mode == SOLVE) {
        counts.aabbs += list.num_moved;
        counts.bullet_aabbs += list.num_left;
    }
}

static void set_aabb(struct broad_phase *broad_phase, struct proxy *proxy,
                     const struct vector3 *min, const struct vector3 *max,
                     void *dispatcher) {
    struct aabbs *list = aabbs;
    if (list != NULL && move_aabb(list, broad_phase, proxy, min, max)) return;
    ((aabb_function *)bullet[SET_AABB])(broad_phase, proxy, min, max, dispatcher);
    if (list != NULL) follow_bullet(list, broad_phase, proxy);
}

static int has_only_links(const struct world *world) {
    struct collision_object *const *objects = world->objects.data;
    for (int i = 0; i < world->objects.size; i++)
        if (objects[i]->internal_type != LINK_COLLIDER) return 0;
    return 1;
}

/*
 * Serializes the bodies of a world.
 *
 * Afterwards, Bullet serializes the collision shapes of the world's objects. Loading a
 * snapshot does not use the shapes, but Bullet scans the snapshot byte by byte, and with
 * a Panda three quarters of the bytes are shapes. Hide the objects of a snapshot, so that
 * it has no shapes.
 */
static void serialize_bodies(struct world *world, void *serializer) {
    ((serialize_function *)bullet[SERIALIZE_BODIES])(world, serializer);
    if (snapshot == NULL) return;
    const int hides = has_only_links(world);
    if (mode == SOLVE) *(hides ? &counts.snapshots : &counts.bullet_snapshots) += 1;
    if (!hides) return;
    *snapshot = (struct snapshot){world, world->objects.size};
    world->objects.size = 0;
}

/* Stores a function in a slot of a vtable. Returns 0, or 1 if the system does not make
   the page writable. */
static int store(void **slot, void *function) {
    const uintptr_t page_size = (uintptr_t)sysconf(_SC_PAGESIZE);
    void *page = (void *)((uintptr_t)slot & ~(page_size - 1));
    if (mprotect(page, page_size, PROT_READ | PROT_WRITE) != 0) return 1;
    __atomic_store_n(slot, function, __ATOMIC_RELEASE);
    mprotect(page, page_size, PROT_READ);
    return 0;
}

int solver_version(void) { return VERSION; }

/* Puts Bullet's functions back into their slots. */
void solver_uninstall(void) {
    for (int i = 0; i < NUM_FUNCTIONS; i++)
        if (slots[i] != NULL) store(slots[i], bullet[i]);
}

/* Replaces Bullet's functions in their slots. Returns 0, or 1 if the system does not
   make a page writable. */
int solver_install(void **const *new_slots, void *const *functions) {
    void *const replacements[] = {(void *)iterations, (void *)convert,
                                  (void *)motor_rows, (void *)limit_rows,
                                  (void *)external_forces, (void *)process_command,
                                  (void *)update_aabbs, (void *)set_aabb,
                                  (void *)serialize_bodies};
    for (int i = 0; i < NUM_FUNCTIONS; i++) {
        slots[i] = new_slots[i];
        bullet[i] = functions[i];
    }
    for (int i = 0; i < NUM_FUNCTIONS; i++)
        if (store(slots[i], replacements[i])) {
            solver_uninstall();
            return 1;
        }
    return 0;
}

/* Makes all threads in mode FOLLOW run the replacements, or Bullet's functions. */
void solver_enable(int on) { __atomic_store_n(&enabled, on, __ATOMIC_RELAXED); }

/* Sets the mode of the calling thread, and resets its counts to zero. */
void solver_set_mode(enum mode new_mode, const struct expectation *expected) {
    mode = new_mode;
    counts = (struct counts){0};
    probed_world = NULL;
    if (expected != NULL) expectation = *expected;
}

void solver_counts(struct counts *result) { *result = counts; }
#endif
