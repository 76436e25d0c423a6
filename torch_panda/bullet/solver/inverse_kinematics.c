/*
 * Inverse kinematics of a robot: joint positions that bring one link to a pose.
 *
 * Functions here, and their counterparts in Bullet
 * ------------------------------------------------
 * solve_inverse_kinematics  PhysicsServerCommandProcessor::
 *                           processCalculateInverseKinematicsCommand
 * find_tree                 ...InternalData::findOrCreateTree, without creating one
 * compute_kinematics        MultiBodyTree::calculateInverseDynamics and
 *                           calculateJacobians, for the links that lead to the target
 * turn_about_axis           bodyTParentFromAxisAngle
 * orientation_error         IKTrajectoryHelper::computeIK, its angular part
 * solve                     MatrixRmn::Solve and ConvertToRefNoFree
 * damped_step               Jacobian::CalcDeltaThetasDLS2
 *
 * Each iteration computes the pose of the link, its Jacobian, and a step of damped least
 * squares.
 *
 * Why the results are the same bits
 * ---------------------------------
 * Every number is the result of Bullet's operations in Bullet's order. The code is faster
 * because it leaves out three parts:
 *
 * 1. Forces at the joints, velocities and accelerations, which Bullet computes too.
 * 2. Links that do not lead to the target, and Jacobians of all other links.
 * 3. Products with the zeros of a cross product's matrix. The sign of a zero in the
 *    Jacobian may therefore differ from Bullet's. It has no effect: every sum of Bullet
 *    over the Jacobian begins with 0.0.
 *
 * Bullet's function creates a copy of the body's frames and axes, its tree, when the
 * first command asks for it. This command is left to Bullet. Later commands read the same
 * tree, so that both functions use the same numbers, whatever happens to the body. Bullet
 * overwrites all other numbers of a tree before it reads them.
 *
 * If a Jacobian or a result is not finite, Bullet's function computes everything again.
 */
#if defined(__x86_64__) && defined(__linux__)
#define _GNU_SOURCE
#include "rows.h"
#include "solver.h"
#include "vectors.h"

#include <math.h>

enum { MAX_DOFS = 32, NUM_ROWS = 6 };

#define PI 3.1415926535897932384626433832795028841972

static const double MAX_STEP = 45.0 * (PI / 180); /* Jacobian::MaxAngleDLS */
static const double FAR = 1e30f;

/* The links from the base to the target. */
struct chain {
    int num_links, num_dofs; /* num_dofs counts all joints of the body */
    const struct tree_link *links[MAX_LINKS];
};

/* The pose of the target link in the frame of the base, and its Jacobian: one row for
   each component of the linear and then of the angular velocity. */
struct kinematics {
    struct vector3 position;
    struct matrix3 rotation;
    double jacobian[NUM_ROWS][MAX_DOFS];
};

/* The matrix and the right side of the equations of a step. */
typedef double equations[MAX_DOFS][MAX_DOFS + 2];

static inline double dot(struct vector3 a, struct vector3 b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline struct vector3 plus(struct vector3 a, struct vector3 b) {
    return (struct vector3){a.x + b.x, a.y + b.y, a.z + b.z, 0.0};
}

static inline struct vector3 minus(struct vector3 a, struct vector3 b) {
    return (struct vector3){a.x - b.x, a.y - b.y, a.z - b.z, 0.0};
}

static inline struct vector3 scale(struct vector3 a, double factor) {
    return (struct vector3){a.x * factor, a.y * factor, a.z * factor, 0.0};
}

static inline struct vector3 rotate(const struct matrix3 *m, struct vector3 a) {
    return (struct vector3){dot(m->row[0], a), dot(m->row[1], a), dot(m->row[2], a), 0.0};
}

static inline struct matrix3 transpose(const struct matrix3 *m) {
    const struct vector3 *r = m->row;
    return (struct matrix3){{{r[0].x, r[1].x, r[2].x, 0.0},
                             {r[0].y, r[1].y, r[2].y, 0.0},
                             {r[0].z, r[1].z, r[2].z, 0.0}}};
}

static inline struct matrix3 multiply(const struct matrix3 *a, const struct matrix3 *b) {
    struct matrix3 result;
    for (int i = 0; i < 3; i++) {
        const struct vector3 row = a->row[i];
        result.row[i] = plus(plus(scale(b->row[0], row.x), scale(b->row[1], row.y)),
                             scale(b->row[2], row.z));
    }
    return result;
}

static struct matrix3 turn_about_axis(struct vector3 axis, double angle) {
    double sine, c;
    sincos(angle, &sine, &c);
    const double s = -sine, rest = 1.0 - c, x = axis.x, y = axis.y, z = axis.z;
    return (struct matrix3){
        {{x * x * rest + c, x * y * rest - z * s, x * z * rest + y * s, 0.0},
         {x * y * rest + z * s, y * y * rest + c, y * z * rest - x * s, 0.0},
         {x * z * rest - y * s, y * z * rest + x * s, z * z * rest + c, 0.0}}};
}

static void compute_kinematics(struct kinematics *result, const struct chain *chain,
                               const double *joint_positions) {
    struct vector3 linear[MAX_DOFS], angular[MAX_DOFS]; /* columns, in the link's frame */
    int dofs[MAX_DOFS], count = 0;
    struct vector3 position = {0.0, 0.0, 0.0, 0.0};
    struct matrix3 from_base = {
        {{1.0, 0.0, 0.0, 0.0}, {0.0, 1.0, 0.0, 0.0}, {0.0, 0.0, 1.0, 0.0}}};
    for (int i = 0; i < chain->num_links; i++) {
        const struct tree_link *link = chain->links[i];
        struct matrix3 rotation = link->rotation;
        struct vector3 arm = link->position;
        if (link->joint_type == TREE_REVOLUTE) {
            const struct matrix3 turn =
                turn_about_axis(link->axis, joint_positions[link->dof]);
            rotation = multiply(&turn, &rotation);
        } else if (link->joint_type == TREE_PRISMATIC) {
            arm = plus(arm, scale(link->slide, joint_positions[link->dof]));
        }
        position = plus(position, arm);
        position = rotate(&rotation, position);
        from_base = multiply(&rotation, &from_base);
        for (int k = 0; k < count; k++) {
            const struct vector3 moved = minus(linear[k], cross(&arm, &angular[k]));
            linear[k] = rotate(&rotation, moved);
            angular[k] = rotate(&rotation, angular[k]);
        }
        if (link->joint_type == TREE_FIXED) continue;
        dofs[count] = link->dof;
        linear[count] = (struct vector3){0.0, 0.0, 0.0, 0.0};
        angular[count] = link->axis;
        if (link->joint_type == TREE_PRISMATIC)
            linear[count] = rotate(&rotation, link->slide);
        count++;
    }
    result->rotation = transpose(&from_base);
    result->position = rotate(&result->rotation, position);
    memset(result->jacobian, 0, sizeof result->jacobian);
    for (int k = 0; k < count; k++) {
        const struct vector3 parts[2] = {rotate(&result->rotation, linear[k]),
                                         rotate(&result->rotation, angular[k])};
        for (int part = 0; part < 2; part++) {
            result->jacobian[3 * part][dofs[k]] = parts[part].x;
            result->jacobian[3 * part + 1][dofs[k]] = parts[part].y;
            result->jacobian[3 * part + 2][dofs[k]] = parts[part].z;
        }
    }
}

/* The rotation from a matrix to a quaternion, as an axis times an angle. */
static struct vector3 orientation_error(const struct matrix3 *rotation,
                                        struct vector3 target) {
    /* Like Bullet, convert to a quaternion, back to a matrix, and to a quaternion. */
    const struct vector3 once = get_rotation(rotation);
    const struct matrix3 again = rotation_matrix(&once);
    const struct vector3 p = target, q = get_rotation(&again);
    /* The product of the target with the inverse of q. */
    const struct vector3 turn = {p.w * -q.x + p.x * q.w + p.y * -q.z - p.z * -q.y,
                                 p.w * -q.y + p.y * q.w + p.z * -q.x - p.x * -q.z,
                                 p.w * -q.z + p.z * q.w + p.x * -q.y - p.y * -q.x,
                                 p.w * q.w - p.x * -q.x - p.y * -q.y - p.z * -q.z};
    const double cosine = turn.w < -1.0 ? -1.0 : turn.w > 1.0 ? 1.0 : turn.w;
    float angle = (float)(2.0 * acos(cosine));
    if (angle > PI) angle = (float)(angle - 2.0 * PI);
    const double square = 1.0 - turn.w * turn.w;
    struct vector3 axis = {1.0, 0.0, 0.0, 0.0};
    if (!(square < 10.0 * EPSILON)) axis = scale(turn, 1.0 / sqrt(square));
    axis = scale(axis, 1.0 / sqrt(dot(axis, axis)));
    return scale(axis, angle);
}

/* Solves the equations by Gauss's elimination, and changes them. */
static void solve(equations e, int size, double *solution) {
    for (int k = 0; k < size - 1; k++) {
        int pivot = k;
        for (int i = k + 1; i < size; i++)
            if (fabs(e[i][k]) > fabs(e[pivot][k])) pivot = i;
        if (pivot != k)
            for (int j = k; j <= size; j++) {
                const double number = e[k][j];
                e[k][j] = e[pivot][j];
                e[pivot][j] = number;
            }
        for (int i = k + 1; i < size; i++) {
            const double factor = e[i][k] / e[k][k];
            for (int j = k + 1; j <= size; j++) e[i][j] -= e[k][j] * factor;
        }
    }
    for (int i = size - 1; i >= 0; i--) {
        double rest = e[i][size];
        for (int j = size - 1; j > i; j--) rest -= e[i][j] * solution[j];
        solution[i] = rest / e[i][i];
    }
}

/* Adds a step of damped least squares to the joint positions. */
static void damped_step(double *joint_positions, const struct kinematics *kinematics,
                        const double *error, const double *damping, int num_dofs) {
    equations e;
    double step[MAX_DOFS];
    for (int i = 0; i < num_dofs; i++) {
        for (int j = 0; j <= num_dofs; j++) e[i][j] = 0.0;
        for (int r = 0; r < NUM_ROWS; r++) {
            const double *row = kinematics->jacobian[r];
            for (int j = 0; j < num_dofs; j++) e[i][j] += row[i] * row[j];
            e[i][num_dofs] += error[r] * row[i];
        }
        e[i][i] += damping[i];
    }
    solve(e, num_dofs, step);
    double largest = 0.0;
    for (int i = 0; i < num_dofs; i++)
        if (fabs(step[i]) > largest) largest = fabs(step[i]);
    const double factor = largest > MAX_STEP ? MAX_STEP / largest : 1.0;
    for (int i = 0; i < num_dofs; i++) joint_positions[i] += step[i] * factor;
}

static const struct multi_body *find_body(const struct server_data *data, int id) {
    const struct body_handle *handles = data->body_handles.data;
    if (id < 0 || id >= data->body_handles.size || handles[id].next_free != USED)
        return NULL;
    return handles[id].body;
}

static const struct tree_data *find_tree(const struct server_data *data,
                                         const struct multi_body *body) {
    const struct multi_body *const *bodies = data->tree_bodies.data;
    struct tree *const *trees = data->trees.data;
    for (int i = 0; i < data->tree_bodies.size; i++)
        if (bodies[i] == body) return trees[i] != NULL ? trees[i]->data : NULL;
    return NULL;
}

/*
 * Collects the links from the base to a link, and the positions of all joints.
 *
 * Returns 0 if the tree has another structure than the body, or a joint of another type.
 */
static int collect(struct chain *chain, double *joint_positions,
                   const struct multi_body *body, const struct tree_data *tree,
                   int last) {
    const int num_links = body->links.size;
    const struct tree_link *tree_links = tree->links.data;
    const int *parents = tree->parents.data;
    if (!body->fixed_base || tree->links.size != num_links + 1 ||
        tree->parents.size != num_links + 1 || num_links > MAX_LINKS ||
        body->num_dofs > MAX_DOFS || tree_links[0].joint_type != TREE_FIXED ||
        last < 0 || last >= num_links)
        return 0;
    const struct link *link = body->links.data;
    int num_dofs = 0;
    for (int i = 0; i < num_links; i++, link++) {
        const struct tree_link *own = &tree_links[i + 1];
        const int type = tree_joint_type(link->joint_type);
        if (type < 0 || own->joint_type != type || parents[i + 1] < 0 ||
            parents[i + 1] > i)
            return 0;
        if (type == TREE_FIXED) continue;
        if (num_dofs >= MAX_DOFS || own->dof != num_dofs) return 0;
        joint_positions[num_dofs++] = link->joint_position[0];
    }
    if (num_dofs != body->num_dofs || num_dofs != tree->num_dofs) return 0;
    chain->num_dofs = num_dofs;
    chain->num_links = 0;
    for (int i = last + 1; i > 0; i = parents[i]) chain->num_links++;
    for (int i = last + 1, k = chain->num_links; i > 0; i = parents[i])
        chain->links[--k] = &tree_links[i];
    return 1;
}

int solve_inverse_kinematics(const struct server *server, const struct command *command,
                             struct status *status) {
    const int options = HAS_JOINT_DAMPING | HAS_MAX_ITERATIONS | HAS_RESIDUAL_THRESHOLD;
    const struct multi_body *body = find_body(server->data, command->body);
    if ((command->flags & ~options) != (HAS_TARGET_POSITION | HAS_TARGET_ORIENTATION) ||
        command->num_targets != 1 || server->data->logger != NULL || body == NULL)
        return 0;
    const struct tree_data *tree = find_tree(server->data, body);
    struct chain chain;
    double joint_positions[MAX_DOFS], damping[MAX_DOFS];
    if (tree == NULL ||
        !collect(&chain, joint_positions, body, tree, command->target_links[0]))
        return 0;
    const int num_dofs = chain.num_dofs;
    if (num_dofs == 0) return 0;
    for (int i = 0; i < num_dofs; i++)
        damping[i] = command->flags & HAS_JOINT_DAMPING ? command->damping[i] : 0.5;
    const int num_iterations =
        command->flags & HAS_MAX_ITERATIONS ? command->num_iterations : 20;
    const double threshold =
        command->flags & HAS_RESIDUAL_THRESHOLD ? command->threshold : 1e-4;

    /* The target in the frame of the base. */
    const double *p = command->target_position, *q = command->target_orientation;
    const struct vector3 origin = {p[0], p[1], p[2], 0.0};
    const struct vector3 orientation = {q[0], q[1], q[2], q[3]};
    const struct vector3 base = body->base_rotation;
    const struct vector3 to_world = {-base.x, -base.y, -base.z, base.w};
    const struct matrix3 basis = rotation_matrix(&to_world);
    const struct matrix3 to_base = transpose(&basis);
    const struct vector3 offset = rotate(&to_base, scale(body->base_position, -1.0));
    const struct vector3 target = plus(rotate(&to_base, origin), offset);
    const struct matrix3 target_in_world = rotation_matrix(&orientation);
    const struct matrix3 target_in_base = multiply(&to_base, &target_in_world);
    const struct vector3 target_rotation = get_rotation(&target_in_base);

    double distance = FAR;
    for (int i = 0; i < num_iterations && distance > threshold; i++) {
        struct kinematics kinematics;
        compute_kinematics(&kinematics, &chain, joint_positions);
        const struct vector3 linear = minus(target, kinematics.position);
        const struct vector3 angular =
            orientation_error(&kinematics.rotation, target_rotation);
        distance = sqrt(dot(linear, linear));
        const double error[NUM_ROWS] = {linear.x,  linear.y,  linear.z,
                                        angular.x, angular.y, angular.z};
        damped_step(joint_positions, &kinematics, error, damping, num_dofs);
        double zero = finite_zero(error, NUM_ROWS);
        zero += finite_zero(joint_positions, num_dofs);
        for (int r = 0; r < NUM_ROWS; r++)
            zero += finite_zero(kinematics.jacobian[r], num_dofs);
        if (zero != 0.0) return 0; /* it is NaN */
    }
    if (distance == FAR) return 0; /* no iteration */
    status->type = INVERSE_KINEMATICS_COMPLETED;
    status->num_stream_bytes = 0;
    status->stream = NULL;
    status->body = command->body;
    status->num_dofs = num_dofs;
    memcpy(status->positions, joint_positions, num_dofs * sizeof(double));
    return 1;
}
#endif
