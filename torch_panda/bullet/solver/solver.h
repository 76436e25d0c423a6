/* What the files of the solver know of one another. */
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

/* Unit responses of bodies, as a list that one conversion of a group owns. */
struct responses;
void free_responses(struct responses *list);

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
int convert_manifold(struct solver *solver, struct manifold *manifold,
                     const struct solver_info *info);

/* What the layout probe knows of the scene that it looks at. */
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
