/* Functions that the files of the solver share. */
#ifndef TORCH_PANDA_SOLVER_H
#define TORCH_PANDA_SOLVER_H

#include "bullet_types.h"

/*
 * The iterations of btSequentialImpulseConstraintSolver over the rows of one group.
 *
 * Returns 1 if the group is solved. Returns 0, with nothing changed, if Bullet's own
 * function has to solve it.
 */
int solve_group(struct solver *solver, struct collision_object **bodies, int num_bodies,
                int num_manifolds, int num_constraints, const struct solver_info *info);

enum { MAX_LINKS = 64 }; /* of a body whose responses are computed here */

/* A body with joints: what unit impulses at its joints do. A list of a group's bodies. */
struct responses {
    struct responses *next;
    const struct multi_body *body;
    int is_known;               /* 0: Bullet creates the rows of this body */
    char is_needed[MAX_LINKS];  /* links that have a joint, or move one that has */
    double columns[];           /* (num_dofs, num_dofs), a row for each impulse */
};

/* The responses of a body, or NULL if Bullet has to create its rows. */
const struct responses *get_responses(struct responses **list,
                                      const struct multi_body *body);
void free_responses(struct responses *list);

/*
 * What two sets of impulses at the joints, (num_dofs,) each, do to the joints.
 */
void solve_pair(const struct responses *responses, const double *const impulses[2],
                double *const results[2]);

/*
 * The rows of a joint's motor, and of its limits.
 *
 * Returns 1 if the rows are there. Returns 0, with nothing changed, if Bullet's own
 * function has to create them.
 */
int create_motor_rows(struct responses **responses, struct motor *motor,
                      struct array *rows, struct jacobian_data *data,
                      const struct solver_info *info);
int create_limit_rows(struct responses **responses, struct limit *limit,
                      struct array *rows, struct jacobian_data *data,
                      const struct solver_info *info);

/*
 * The rows of all contacts of a manifold.
 *
 * Returns as the functions above do.
 */
int convert_manifold(struct responses **responses, struct solver *solver,
                     struct manifold *manifold, const struct solver_info *info);

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
};

/*
 * Compare fields with the scene, before Bullet converts a group, and before and after
 * it solves the group.
 *
 * Each returns NULL, or the name of the first field that is not as expected.
 */
const char *probe_manifolds(const struct solver *solver,
                            struct manifold *const *manifolds, int num_manifolds,
                            const struct solver_info *info,
                            const struct expectation *expected);
const char *probe_rows(const struct solver *solver, const struct solver_info *info,
                       const struct expectation *expected);
const char *probe_result(const struct solver *solver,
                         struct collision_object *const *bodies, int num_bodies,
                         int num_manifolds, const struct solver_info *info);

#endif
