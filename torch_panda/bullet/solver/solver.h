/*
 * Functions that the files of the solver share.
 *
 * Bullet solves the contacts and joints of a group of touching bodies together. A
 * manifold holds the contacts of two bodies. A row is one scalar constraint, for example
 * one direction of a contact. The Jacobian of a row maps the velocities of its two
 * bodies to the velocity along the row. The unit response of a row is the change of
 * these velocities by a unit impulse along the row.
 */
#ifndef TORCH_PANDA_SOLVER_H
#define TORCH_PANDA_SOLVER_H

#include "bullet_types.h"

#include <stdint.h>

/*
 * The iterations of btSequentialImpulseConstraintSolver over the rows of one group.
 *
 * Returns 1 if the group is solved. Returns 0, with nothing changed, if Bullet's own
 * function has to solve it.
 */
int solve_group(struct solver *solver, struct collision_object **bodies, int num_bodies,
                int num_manifolds, int num_constraints, const struct solver_info *info);

enum { MAX_LINKS = 64 }; /* of a body whose responses are computed here */

/* The responses of a body to unit impulses at its joints. The bodies of a group form a
   linked list. */
struct responses {
    struct responses *next;
    const struct multi_body *body;
    int is_known;              /* 0 if Bullet has to create the rows of this body */
    char is_needed[MAX_LINKS]; /* whether the link or a descendant has a joint */
    double columns[]; /* (num_dofs, num_dofs): changes of all joint velocities by a unit
                         impulse at each joint */
};

/* The responses of a body, or NULL if Bullet has to create its rows. */
const struct responses *get_responses(struct responses **list,
                                      const struct multi_body *body);
void free_responses(struct responses *list);

/*
 * The changes of all joint velocities by two sets of impulses at the joints.
 *
 * Each impulse and each result is an array (num_dofs,).
 */
void solve_pair(const struct responses *responses, const double *const impulses[2],
                double *const results[2]);

/*
 * Append the rows of a joint's motor, or of a joint's limits.
 *
 * Return 1 if all rows were created. Return 0, with nothing changed, if Bullet's own
 * function has to create them.
 */
int create_motor_rows(struct responses **responses, struct motor *motor,
                      struct array *rows, struct jacobian_data *data,
                      const struct solver_info *info);
int create_limit_rows(struct responses **responses, struct limit *limit,
                      struct array *rows, struct jacobian_data *data,
                      const struct solver_info *info);

/*
 * Append the rows of all contacts of a manifold.
 *
 * Returns 1 or 0, as the two functions above do.
 */
int convert_manifold(struct responses **responses, struct solver *solver,
                     struct manifold *manifold, const struct solver_info *info);

/* Whether Bullet would accelerate a body in this step and `accelerate` can replace it. */
int can_accelerate(const struct multi_body *body);

/*
 * Accelerate the joints of a body by the forces and torques on it.
 *
 * Returns 1 if the joint velocities have changed. Returns 0 if Bullet's own function has
 * to compute them, because a number is not finite.
 */
int accelerate(struct multi_body *body, double time_step);

/*
 * Answer a command of a client that asks for the inverse kinematics of a body.
 *
 * Returns 1 if the status has the answer. Returns 0, with nothing changed, if Bullet's
 * own function has to answer.
 */
int solve_inverse_kinematics(const struct server *server, const struct command *command,
                             struct status *status);

enum { MAX_OBJECTS = 64 }; /* of a world whose AABBs are moved here */

/* The AABBs of a world's objects, while Bullet updates them all. */
struct aabbs {
    const struct world *world;
    int num_objects; /* 0 until the AABBs have been read */
    int num_pairs;
    int num_moved, num_left; /* AABBs that this solver moved, and those left to Bullet */
    _Alignas(16) double limits[6][MAX_OBJECTS]; /* minimum and maximum of x, y, z */
    uint64_t pairs[MAX_OBJECTS]; /* bit i: whether the pair with object i is known */
};

/*
 * Move the AABB of a link in the broad phase.
 *
 * Returns 1 if the AABB was moved. Returns 0, with nothing changed, if Bullet's own
 * function has to move it. After Bullet has moved it, call follow_bullet.
 */
int move_aabb(struct aabbs *aabbs, struct broad_phase *broad_phase, struct proxy *proxy,
              const struct vector3 *min, const struct vector3 *max);
void follow_bullet(struct aabbs *aabbs, const struct broad_phase *broad_phase,
                   const struct proxy *proxy);

/* Numbers of the self-test's scene, for the layout probe. */
struct expectation {
    void **motor_table, **limit_table; /* of virtual functions */
    double time_step;
    double residual_threshold;
    double motor_impulse; /* of every motor: largest force times time step */
    double friction;      /* of every contact */
    double restitution;   /* of every contact */
    double masses[2];     /* of the bodies that move and have no joints */
    int num_iterations;
    int num_dofs; /* joints of the one body that has joints */
    int num_links;
    const int *joint_types; /* of its links */
    double kp, kd; /* of all motors */
    int num_bodies;
    const double *link_masses; /* of the body that has joints */
    double gravity;            /* along z */
    double joint_damping;      /* of all joints */
    double damping;            /* linear and angular, of all bodies */
    double max_velocity;       /* of all coordinates */
    double table_size;         /* of the second body: half its length along x */
    double target[7];          /* pose, of the inverse kinematics */
    double ik_damping;         /* of all joints */
    int ik_iterations;
};

/*
 * Compare the fields of Bullet's structs with the known numbers of the scene.
 *
 * probe_world does this before Bullet accelerates the bodies, and probe_manifolds before
 * Bullet creates the rows of a group. probe_rows does it before Bullet solves the group,
 * and probe_result after Bullet has solved it. probe_command does it after Bullet has
 * answered a command for the inverse kinematics. Each function returns NULL, or the name
 * of the first field that does not have the expected number.
 */
const char *probe_world(const struct world *world, const struct solver_info *info,
                        const struct expectation *expected);
const char *probe_manifolds(const struct solver *solver,
                            struct manifold *const *manifolds, int num_manifolds,
                            const struct solver_info *info,
                            const struct expectation *expected);
const char *probe_rows(const struct solver *solver, const struct solver_info *info,
                       const struct expectation *expected);
const char *probe_result(const struct solver *solver,
                         struct collision_object *const *bodies, int num_bodies,
                         int num_manifolds, const struct solver_info *info);
const char *probe_command(const struct server *server, const struct command *command,
                          const struct status *status, const struct world *world,
                          const struct expectation *expected);

#endif
