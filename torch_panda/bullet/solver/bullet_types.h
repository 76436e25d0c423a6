/*
 * Structs of Bullet that the solver reads or writes.
 *
 * These declarations were written for this package. They name only the fields that it
 * uses; the bytes between are padding. The offsets are those of pybullet 3.2.7 on
 * x86-64, built in double precision (BT_USE_DOUBLE_PRECISION), and come from its debug
 * information. The assertions below compare the declarations with these offsets when the
 * library is compiled. The layout probe, probe.c, compares the fields with a known scene
 * when the program runs.
 */
#ifndef TORCH_PANDA_BULLET_TYPES_H
#define TORCH_PANDA_BULLET_TYPES_H

#include <stddef.h>

/* btAlignedObjectArray<T> */
struct array {
    char allocator[4];
    int size;
    int capacity;
    void *data;
    char owns_memory;
};

/* btVector3 */
struct vector3 {
    double x, y, z, w;
};

/* btMatrix3x3 */
struct matrix3 {
    struct vector3 row[3];
};

/* btSpatialForceVector and btSpatialMotionVector */
struct spatial {
    struct vector3 top, bottom;
};

/* btMultibodyLink */
struct link {
    double mass;
    struct vector3 inertia;
    int parent;
    char pad1[228];
    struct spatial axes[6];
    int dof_offset;
    char pad2[4];
    struct vector3 rotation; /* m_cachedRotParentToThis, a quaternion */
    struct vector3 r_vector; /* m_cachedRVector */
    char pad3[64];
    struct vector3 applied_force, applied_torque;
    char pad4[64];
    double joint_position[7];
    char pad5[56];
    double joint_torque[6];
    struct collision_object *collider;
    int flags;
    int num_dofs;
    int num_positions;
    int joint_type;
    void *joint_feedback;
    struct matrix3 world_basis; /* m_cachedWorldTransform */
    struct vector3 world_origin;
    char pad6[72];
};

/* btCollisionObject */
struct collision_object {
    char pad0[360];
    int has_anisotropic_friction;
    char pad1[12];
    struct proxy *proxy; /* m_broadphaseHandle */
    char pad2[24];
    int flags;
    char pad3[4];
    int companion_id;
    int world_index; /* m_worldArrayIndex */
    int activation_state;
    char pad4[60];
    int internal_type;
};

/* btMultiBodyLinkCollider, a btCollisionObject */
struct link_collider {
    struct collision_object base;
    char pad0[128];
    struct multi_body *body;
    int link;
};

/* btManifoldPoint */
struct contact_point {
    struct vector3 local_a, local_b;
    struct vector3 position_b, position_a, normal_b;
    double distance, friction, rolling_friction, spinning_friction, restitution;
    char pad0[24];
    int flags;
    double impulse, previous_rhs;
    char pad1[32];
    double cfm_or_stiffness, erp_or_damping; /* `flags` says which of the two */
    char pad2[16];
    struct vector3 lateral_1, lateral_2;
};

/* btPersistentManifold */
struct manifold {
    char pad0[8];
    struct contact_point points[4];
    struct link_collider *body_a, *body_b;
    int num_points;
    double breaking_threshold, processing_threshold;
};

/* btMultiBody */
struct multi_body {
    char pad0[8];
    struct collision_object *base_collider;
    char pad1[8];
    struct vector3 base_position;
    char pad2[32];
    struct vector3 base_rotation; /* a quaternion */
    char pad3[32];
    double base_mass;
    struct vector3 base_inertia;
    char pad4[128];
    struct array links; /* of struct link */
    char pad5[32];
    struct array delta_v; /* m_deltaV */
    struct array real_buffer;   /* velocities, then inverses of D at squared offsets */
    struct array vector_buffer; /* h, a struct spatial for each degree of freedom */
    struct array matrix_buffer; /* rotations from the parent, the base's first */
    char pad6[385];
    char fixed_base;
    char pad7[46];
    int companion_id;
    char pad8[4];
    double linear_damping, angular_damping;
    char use_gyro_term;
    char pad9[15];
    double max_velocity; /* m_maxCoordinateVelocity */
    char pad10[1];
    char pos_updated; /* __posUpdated */
    char pad11[2];
    int num_dofs;
    char pad12[4];
    char use_rk4, use_global_velocities;
    char needs_joint_feedback; /* m_internalNeedsJointFeedback */
};

/* btSoftMultiBodyDynamicsWorld */
struct world {
    char pad0[8];
    struct array objects; /* of pointers to struct collision_object */
    char pad1[88];
    struct broad_phase *broad_phase; /* m_broadphasePairCache */
    char pad2[536];
    struct array bodies; /* of pointers to struct multi_body */
};

/* btDbvtAabbMm */
struct aabb {
    struct vector3 min, max;
};

/* btDbvtNode */
struct node {
    struct aabb aabb;
    struct node *parent;
    union {
        struct node *children[2]; /* of a leaf, the second is NULL */
        struct proxy *proxy;
    };
};

/* btDbvt */
struct aabb_tree {
    struct node *root, *free;
    int lookahead; /* m_lkhd */
    int num_leaves;
    unsigned path; /* m_opath */
    char pad0[4];
    struct array stack;
};

/* btDbvtProxy: a link in the broad phase */
struct proxy {
    struct collision_object *object; /* m_clientObject */
    char pad0[16];
    struct aabb aabb;
    struct node *leaf;
    struct proxy *previous, *next; /* of the list of its stage */
    int stage;
};

/* btBroadphasePair */
struct overlapping_pair {
    struct proxy *a, *b;
    char pad0[16];
};

/* btHashedOverlappingPairCache */
struct pair_cache {
    char pad0[8];
    struct array pairs; /* of struct overlapping_pair */
};

/* btDbvtBroadphase */
struct broad_phase {
    char pad0[8];
    struct aabb_tree trees[2]; /* of links that move, and of links that stand still */
    struct proxy *stages[3];
    struct pair_cache *pair_cache;
    double prediction;
    int stage; /* m_stageCurrent */
    char pad1[12];
    int num_new_pairs;
    char pad2[4];
    int num_calls, num_updates; /* m_updates_call, m_updates_done */
    char pad3[21];
    char defers_collisions; /* m_deferedcollide */
    char needs_cleanup;
};

/* btMultiBodySolverConstraint: one row */
struct constraint_row {
    int delta_vel_a, jac_a, delta_vel_b, jac_b;
    struct vector3 relpos1_cross_normal, contact_normal1;
    struct vector3 relpos2_cross_normal, contact_normal2;
    struct vector3 angular_component_a, angular_component_b;
    double applied_push_impulse, applied_impulse;
    double friction, jac_diag_inv, rhs, cfm;
    double lower_limit, upper_limit, rhs_penetration;
    void *contact_point;
    int override_iterations, friction_index;
    int solver_body_a;
    struct multi_body *multi_body_a;
    int link_a;
    int solver_body_b;
    struct multi_body *multi_body_b;
    int link_b;
    struct constraint *constraint;
    int constraint_row;
};

/* btMultiBodyJacobianData */
struct jacobian_data {
    struct array jacobians, unit_impulses, delta_velocities;
    struct array scratch_r, scratch_v, scratch_m;
    struct array *solver_bodies;
    int fixed_body;
};

/* btMultiBodyConstraintSolver, and its base btSequentialImpulseConstraintSolver */
struct solver {
    void **vtable;
    struct array solver_bodies;
    struct array contact_rows, joint_rows, friction_rows, rolling_rows;
    char pad0[128];
    int max_override_iterations;
    char pad1[68];
    double residual; /* m_leastSquaresResidual */
    char pad2[8];
    struct {
        int island, num_bodies, num_manifolds, num_calls, num_iterations;
        double residual;
    } analytics;
    struct array multi_body_joint_rows; /* m_multiBodyNonContactConstraints */
    struct array multi_body_normal_rows;
    struct array multi_body_friction_rows;
    struct array multi_body_torsional_rows;
    struct array multi_body_spinning_rows;
    struct jacobian_data data;
    struct constraint **constraints; /* m_tmpMultiBodyConstraints, of this group */
    int num_constraints;
};

/* btContactSolverInfo */
struct solver_info {
    char pad0[24];
    double time_step;
    char pad1[8];
    int num_iterations;
    char pad2[12];
    double relaxation; /* m_sor */
    double erp, erp2;
    char pad3[24];
    double cfm, friction_erp, friction_cfm;
    int split_impulse;
    double split_impulse_threshold;
    char pad4[8];
    double linear_slop;
    char pad5[16];
    int mode;
    char pad6[28];
    double residual_threshold, restitution_threshold;
    char pad7[4];
    int report_analytics;
    int num_inner_iterations; /* m_numNonContactInnerIterations */
};

/* btMultiBodyConstraint */
struct constraint {
    void **vtable;
    struct multi_body *body_a, *body_b;
    int link_a, link_b;
    int type;
    int num_rows;
    int jac_size_a, jac_size_both;
    int position_offset;
    char is_unilateral;
    int num_dofs_finalized;
    double max_impulse;
    struct array data; /* a number, the Jacobians and a position for each row */
};

/* btMultiBodyJointMotor */
struct motor {
    struct constraint base;
    double desired_velocity, desired_position;
    double kd, kp, erp, rhs_clamp;
};

/* btMultiBodyJointLimitConstraint */
struct limit {
    struct constraint base;
    double lower, upper;
};

/*
 * btInverseDynamicsBullet3::RigidBody: the base of a body, or a link.
 *
 * Bullet copies the fields from btMultiBody when a client first asks for the inverse
 * kinematics, the Jacobian or the inverse dynamics of the body.
 */
struct tree_link {
    double mass;
    char pad0[832];
    int joint_type;
    char pad1[4];
    struct vector3 position; /* m_parent_pos_parent_body_ref */
    struct matrix3 rotation; /* m_body_T_parent_ref, from the parent */
    struct vector3 axis;     /* m_Jac_JR, zero if the joint does not rotate */
    char pad2[32];
    struct vector3 slide; /* m_parent_Jac_JT, zero if the joint does not slide */
    int dof;              /* m_q_index, or -1 */
    char pad3[380];
};

/* btInverseDynamicsBullet3::MultiBodyTree::MultiBodyImpl */
struct tree_data {
    int num_links, num_dofs; /* the base counts as a link */
    char pad0[32];
    struct array links;   /* of struct tree_link; the base comes first */
    struct array parents; /* indices in `links` */
};

/* btInverseDynamicsBullet3::MultiBodyTree */
struct tree {
    char is_finalized;
    char pad0[7];
    struct tree_data *data;
};

/* b3PoolBodyHandle<InternalBodyData> */
struct body_handle {
    struct multi_body *body;
    char pad0[320];
    int next_free;
    char pad1[4];
};

/* PhysicsServerCommandProcessorInternalData */
struct server_data {
    char pad0[56];
    struct array body_handles; /* of struct body_handle, by body id */
    char pad1[3192];
    void *logger; /* m_commandLogger */
    char pad2[144];
    struct array trees;       /* values of the map m_inverseDynamicsBodies */
    struct array tree_bodies; /* its keys: pointers to struct multi_body */
};

/* PhysicsServerCommandProcessor */
struct server {
    void **vtable;
    struct server_data *data;
};

/* SharedMemoryCommand with CalculateInverseKinematicsArgs */
struct command {
    int type;
    char pad0[16];
    int flags; /* m_updateFlags */
    int body;
    char pad1[4];
    double target_position[384];
    int num_targets; /* m_numEndEffectorLinkIndices */
    char pad2[4];
    double target_orientation[512];
    int target_links[128];
    char pad3[4096];
    double damping[128]; /* m_jointDamping */
    double positions[128];
    int num_iterations;
    char pad4[4];
    double threshold; /* m_residualThreshold */
};

/* SharedMemoryStatus with CalculateInverseKinematicsResultArgs */
struct status {
    int type;
    char pad0[16];
    int num_stream_bytes;
    void *stream;
    char pad1[8];
    int body, num_dofs;
    double positions[128];
};

/* enum EnumSharedMemoryClientCommand and EnumSharedMemoryServerStatus */
enum {
    CALCULATE_INVERSE_KINEMATICS = 27,
    SAVE_STATE = 60,
    INVERSE_KINEMATICS_COMPLETED = 43,
};

/* enum EnumCalculateInverseKinematicsFlags */
enum {
    HAS_TARGET_POSITION = 16,
    HAS_TARGET_ORIENTATION = 32,
    HAS_JOINT_DAMPING = 128,
    HAS_MAX_ITERATIONS = 512,
    HAS_RESIDUAL_THRESHOLD = 1024,
};

/* B3_POOL_HANDLE_TERMINAL_USED: `next_free` of a body that exists */
enum { USED = -2 };

/* enum btMultibodyLink::eFeatherstoneJointType */
enum { REVOLUTE = 0, PRISMATIC = 1, FIXED = 4 };

/* enum btInverseDynamicsBullet3::JointType */
enum { TREE_FIXED = 0, TREE_REVOLUTE = 1, TREE_PRISMATIC = 2 };

/* The type of a joint in a tree, or -1 if this package does not know the type. */
static inline int tree_joint_type(int joint_type) {
    return joint_type == REVOLUTE    ? TREE_REVOLUTE
           : joint_type == PRISMATIC ? TREE_PRISMATIC
           : joint_type == FIXED     ? TREE_FIXED
                                     : -1;
}

/* enum btCollisionObject::CollisionFlags, and of CollisionObjectTypes */
enum { STATIC = 1, KINEMATIC = 2, LINK_COLLIDER = 64 };

/* Activation states: ACTIVE_TAG and ISLAND_SLEEPING */
enum { ACTIVE = 1, ASLEEP = 2 };

/* The stage of a link that stands still: btDbvtBroadphase::STAGECOUNT */
enum { FIXED_STAGE = 2 };

/* enum btSolverMode */
enum {
    TWO_FRICTION_DIRECTIONS = 16,
    CACHED_FRICTION_DIRECTIONS = 32,
    FIXED_FRICTION_DIRECTIONS = 64, /* independent of velocities */
    NO_FRICTION_CONE = 2048,
    ARTICULATED_WARMSTARTING = 4096,
};

/* enum btContactPointFlags */
enum {
    LATERAL_FRICTION_INITIALIZED = 1,
    HAS_CFM = 2,
    HAS_ERP = 4,
    HAS_STIFFNESS_AND_DAMPING = 8,
    FRICTION_ANCHOR = 16,
};

#define AT(type, field, offset)                                                        \
    _Static_assert(offsetof(struct type, field) == (offset), #type "." #field)
#define SIZE(type, bytes) _Static_assert(sizeof(struct type) == (bytes), #type)

AT(array, size, 4);
AT(array, data, 16);
SIZE(array, 32);
AT(link, parent, 40);
AT(link, axes, 272);
AT(link, dof_offset, 656);
AT(link, rotation, 664);
AT(link, r_vector, 696);
AT(link, applied_force, 792);
AT(link, applied_torque, 824);
AT(link, joint_position, 920);
AT(link, joint_torque, 1032);
AT(link, collider, 1080);
AT(link, flags, 1088);
AT(link, num_dofs, 1092);
AT(link, joint_type, 1100);
AT(link, joint_feedback, 1104);
AT(link, world_basis, 1112);
AT(link, world_origin, 1208);
SIZE(link, 1312);
AT(collision_object, has_anisotropic_friction, 360);
AT(collision_object, proxy, 376);
AT(collision_object, flags, 408);
AT(collision_object, companion_id, 416);
AT(collision_object, world_index, 420);
AT(collision_object, activation_state, 424);
AT(collision_object, internal_type, 488);
AT(link_collider, body, 624);
AT(link_collider, link, 632);
AT(contact_point, position_b, 64);
AT(contact_point, distance, 160);
AT(contact_point, restitution, 192);
AT(contact_point, flags, 224);
AT(contact_point, impulse, 232);
AT(contact_point, previous_rhs, 240);
AT(contact_point, cfm_or_stiffness, 280);
AT(contact_point, erp_or_damping, 288);
AT(contact_point, lateral_1, 312);
AT(contact_point, lateral_2, 344);
SIZE(contact_point, 376);
AT(manifold, points, 8);
AT(manifold, body_a, 1512);
AT(manifold, body_b, 1520);
AT(manifold, num_points, 1528);
AT(manifold, processing_threshold, 1544);
AT(multi_body, base_collider, 8);
AT(multi_body, base_position, 24);
AT(multi_body, base_rotation, 88);
AT(multi_body, base_mass, 152);
AT(multi_body, base_inertia, 160);
AT(multi_body, links, 320);
AT(multi_body, delta_v, 384);
AT(multi_body, real_buffer, 416);
AT(multi_body, vector_buffer, 448);
AT(multi_body, matrix_buffer, 480);
AT(multi_body, fixed_base, 897);
AT(multi_body, companion_id, 944);
AT(multi_body, linear_damping, 952);
AT(multi_body, use_gyro_term, 968);
AT(multi_body, max_velocity, 984);
AT(multi_body, pos_updated, 993);
AT(multi_body, num_dofs, 996);
AT(multi_body, use_rk4, 1004);
AT(multi_body, needs_joint_feedback, 1006);
AT(world, objects, 8);
AT(world, broad_phase, 128);
AT(world, bodies, 672);
AT(node, parent, 64);
AT(node, children, 72);
SIZE(node, 88);
AT(aabb_tree, lookahead, 16);
SIZE(aabb_tree, 64);
AT(proxy, aabb, 24);
AT(proxy, leaf, 88);
AT(proxy, previous, 96);
AT(proxy, stage, 112);
SIZE(overlapping_pair, 32);
AT(pair_cache, pairs, 8);
AT(broad_phase, trees, 8);
AT(broad_phase, stages, 136);
AT(broad_phase, pair_cache, 160);
AT(broad_phase, prediction, 168);
AT(broad_phase, stage, 176);
AT(broad_phase, num_new_pairs, 192);
AT(broad_phase, num_calls, 200);
AT(broad_phase, num_updates, 204);
AT(broad_phase, defers_collisions, 229);
AT(broad_phase, needs_cleanup, 230);
AT(constraint_row, relpos1_cross_normal, 16);
AT(constraint_row, applied_impulse, 216);
AT(constraint_row, friction, 224);
AT(constraint_row, jac_diag_inv, 232);
AT(constraint_row, rhs, 240);
AT(constraint_row, cfm, 248);
AT(constraint_row, lower_limit, 256);
AT(constraint_row, upper_limit, 264);
AT(constraint_row, contact_point, 280);
AT(constraint_row, friction_index, 292);
AT(constraint_row, solver_body_a, 296);
AT(constraint_row, multi_body_a, 304);
AT(constraint_row, link_a, 312);
AT(constraint_row, solver_body_b, 316);
AT(constraint_row, multi_body_b, 320);
AT(constraint_row, link_b, 328);
AT(constraint_row, constraint, 336);
AT(constraint_row, constraint_row, 344);
SIZE(constraint_row, 352);
AT(jacobian_data, scratch_r, 96);
AT(jacobian_data, solver_bodies, 192);
AT(jacobian_data, fixed_body, 200);
AT(solver, contact_rows, 40);
AT(solver, rolling_rows, 136);
AT(solver, max_override_iterations, 296);
AT(solver, residual, 368);
AT(solver, analytics, 384);
AT(solver, analytics.num_iterations, 400);
AT(solver, analytics.residual, 408);
AT(solver, multi_body_joint_rows, 416);
AT(solver, multi_body_spinning_rows, 544);
AT(solver, data, 576);
AT(solver, constraints, 784);
AT(solver, num_constraints, 792);
AT(constraint, body_a, 8);
AT(constraint, link_a, 24);
AT(constraint, num_rows, 36);
AT(constraint, jac_size_a, 40);
AT(constraint, position_offset, 48);
AT(constraint, num_dofs_finalized, 56);
AT(constraint, max_impulse, 64);
AT(constraint, data, 72);
AT(motor, desired_velocity, 104);
AT(motor, rhs_clamp, 144);
AT(limit, lower, 104);
AT(limit, upper, 112);
AT(solver_info, time_step, 24);
AT(solver_info, num_iterations, 40);
AT(solver_info, relaxation, 56);
AT(solver_info, erp, 64);
AT(solver_info, cfm, 104);
AT(solver_info, friction_erp, 112);
AT(solver_info, friction_cfm, 120);
AT(solver_info, linear_slop, 152);
AT(solver_info, split_impulse, 128);
AT(solver_info, split_impulse_threshold, 136);
AT(solver_info, mode, 176);
AT(solver_info, residual_threshold, 208);
AT(solver_info, restitution_threshold, 216);
AT(solver_info, num_inner_iterations, 232);
AT(tree_link, joint_type, 840);
AT(tree_link, position, 848);
AT(tree_link, rotation, 880);
AT(tree_link, axis, 976);
AT(tree_link, slide, 1040);
AT(tree_link, dof, 1072);
SIZE(tree_link, 1456);
AT(tree_data, links, 40);
AT(tree_data, parents, 72);
AT(tree, data, 8);
AT(body_handle, next_free, 328);
SIZE(body_handle, 336);
AT(server_data, body_handles, 56);
AT(server_data, logger, 3280);
AT(server_data, trees, 3432);
AT(server_data, tree_bodies, 3464);
AT(command, flags, 20);
AT(command, body, 24);
AT(command, target_position, 32);
AT(command, num_targets, 3104);
AT(command, target_orientation, 3112);
AT(command, target_links, 7208);
AT(command, damping, 11816);
AT(command, num_iterations, 13864);
AT(command, threshold, 13872);
AT(status, num_stream_bytes, 20);
AT(status, stream, 24);
AT(status, body, 40);
AT(status, num_dofs, 44);
AT(status, positions, 48);

#undef AT
#undef SIZE

#endif
