/* The Push scene stepped by POSIX threads over Bullet's C API, without Python.

   A vector environment on the same threads cannot be faster: a step submits the
   commands that ours submits, and threads never wait for each other. Built and run by
   bare_bullet.py: the b3 functions are found in pybullet's extension module. */

#include <pthread.h>
#include <stdlib.h>
#include <time.h>

typedef void *handle;

enum {
    JOINTS = 9,              /* movable ones of the Panda; two of them are fingers */
    EE_LINK = 11,
    SUBSTEPS = 20,           /* of 2 ms a step */
    EPISODE = 50,            /* steps */
    IGNORE_VISUALS = 1 << 20, /* URDF_IGNORE_VISUAL_SHAPES */
    POSITION_VELOCITY_PD = 2
};

struct link_state { /* b3LinkState; the first entry is all that is used */
    double position[3];
    double rest[34];
};

handle b3ConnectPhysicsDirect(void);
void b3DisconnectSharedMemory(handle client);
handle b3SubmitClientCommandAndWaitStatus(handle client, handle command);
handle b3InitPhysicsParamCommand(handle client);
int b3PhysicsParamSetTimeStep(handle command, double timestep);
int b3PhysicsParamSetGravity(handle command, double x, double y, double z);
handle b3LoadUrdfCommandInit(handle client, const char *path);
int b3LoadUrdfCommandSetStartPosition(handle command, double x, double y, double z);
int b3LoadUrdfCommandSetUseFixedBase(handle command, int fixed);
int b3LoadUrdfCommandSetFlags(handle command, int flags);
int b3GetStatusBodyIndex(handle status);
handle b3CreateCollisionShapeCommandInit(handle client);
int b3CreateCollisionShapeAddBox(handle command, const double *half_extents);
int b3GetStatusCollisionShapeUniqueId(handle status);
handle b3CreateMultiBodyCommandInit(handle client);
int b3CreateMultiBodyBase(handle command, double mass, int collision, int visual,
                          const double *position, const double *orientation,
                          const double *inertial_position,
                          const double *inertial_orientation);
handle b3InitChangeDynamicsInfo(handle client);
int b3ChangeDynamicsInfoSetLateralFriction(handle command, int body, int link,
                                           double friction);
int b3ChangeDynamicsInfoSetSpinningFriction(handle command, int body, int link,
                                            double friction);
handle b3CreatePoseCommandInit(handle client, int body);
int b3CreatePoseCommandSetJointPosition(handle client, handle command, int joint,
                                        double position);
int b3CreatePoseCommandSetBasePosition(handle command, double x, double y, double z);
int b3CreatePoseCommandSetBaseOrientation(handle command, double x, double y, double z,
                                          double w);
handle b3CalculateInverseKinematicsCommandInit(handle client, int body);
void b3CalculateInverseKinematicsAddTargetPositionWithOrientation(
    handle command, int link, const double *position, const double *orientation);
int b3GetStatusInverseKinematicsJointPositions(handle status, int *body, int *count,
                                               double *positions);
handle b3JointControlCommandInit2(handle client, int body, int mode);
int b3JointControlSetDesiredPosition(handle command, int q_index, double position);
int b3JointControlSetDesiredVelocity(handle command, int u_index, double velocity);
int b3JointControlSetKp(handle command, int u_index, double gain);
int b3JointControlSetKd(handle command, int u_index, double gain);
int b3JointControlSetMaximumForce(handle command, int u_index, double force);
handle b3InitStepSimulationCommand(handle client);
handle b3RequestActualStateCommandInit(handle client, int body);
int b3RequestActualStateCommandComputeLinkVelocity(handle command, int compute);
int b3GetLinkState(handle client, handle status, int link, struct link_state *state);

static const int joint_index[JOINTS] = {0, 1, 2, 3, 4, 5, 6, 9, 10};
static const double neutral[JOINTS] = {0, 0.41, 0, -1.85, 0, 2.26, 0.79, 0, 0};
static const double force[JOINTS] = {87, 87, 87, 87, 12, 120, 120, 170, 170};
static const double no_rotation[4] = {0, 0, 0, 1};
static const double downwards[4] = {1, 0, 0, 0};
static const double origin[3] = {0, 0, 0};

struct environment {
    handle client;
    int robot, cube, target;
    struct link_state ee;
    unsigned random; /* state of a linear congruential generator */
};

struct share { /* of the environments, for one thread */
    struct environment *environments;
    int first, stride, count, steps;
};

static handle submit(struct environment *env, handle command) {
    return b3SubmitClientCommandAndWaitStatus(env->client, command);
}

static double uniform(struct environment *env) { /* in [-1, 1) */
    env->random = env->random * 1664525u + 1013904223u;
    return (env->random >> 8) / 8388608.0 - 1.0;
}

static int create_body(struct environment *env, int shape, double mass,
                       const double *position) {
    handle command = b3CreateMultiBodyCommandInit(env->client);
    b3CreateMultiBodyBase(command, mass, shape, -1, position, no_rotation, origin,
                          no_rotation);
    return b3GetStatusBodyIndex(submit(env, command));
}

static int create_box(struct environment *env, double x, double y, double z,
                      double mass, double center_x, double center_z) {
    double half_extents[3] = {x, y, z}, center[3] = {center_x, 0, center_z};
    handle command = b3CreateCollisionShapeCommandInit(env->client);
    b3CreateCollisionShapeAddBox(command, half_extents);
    int shape = b3GetStatusCollisionShapeUniqueId(submit(env, command));
    return create_body(env, shape, mass, center);
}

static void build(struct environment *env, const char *urdf, int index) {
    const double on_table[3] = {0, 0, 0.02};
    env->random = 77 * index + 1;
    env->client = b3ConnectPhysicsDirect();
    handle command = b3InitPhysicsParamCommand(env->client);
    b3PhysicsParamSetTimeStep(command, 0.002);
    b3PhysicsParamSetGravity(command, 0, 0, -9.81);
    submit(env, command);
    command = b3LoadUrdfCommandInit(env->client, urdf);
    b3LoadUrdfCommandSetStartPosition(command, -0.6, 0, 0);
    b3LoadUrdfCommandSetUseFixedBase(command, 1);
    b3LoadUrdfCommandSetFlags(command, IGNORE_VISUALS);
    env->robot = b3GetStatusBodyIndex(submit(env, command));
    for (int finger = 9; finger <= 10; finger++) {
        command = b3InitChangeDynamicsInfo(env->client);
        b3ChangeDynamicsInfoSetLateralFriction(command, env->robot, finger, 1.0);
        b3ChangeDynamicsInfoSetSpinningFriction(command, env->robot, finger, 0.001);
        submit(env, command);
    }
    create_box(env, 3, 3, 0.01, 0, 0, -0.41);            /* ground */
    create_box(env, 0.55, 0.35, 0.2, 0, -0.3, -0.2);     /* table */
    env->cube = create_box(env, 0.02, 0.02, 0.02, 1, 0, 0.02);
    env->target = create_body(env, -1, 0, on_table);
}

static void read_state(struct environment *env) {
    handle command = b3RequestActualStateCommandInit(env->client, env->robot);
    b3RequestActualStateCommandComputeLinkVelocity(command, 1);
    b3GetLinkState(env->client, submit(env, command), EE_LINK, &env->ee);
    submit(env, b3RequestActualStateCommandInit(env->client, env->cube));
}

static void place(struct environment *env, int body) { /* somewhere on the table */
    handle command = b3CreatePoseCommandInit(env->client, body);
    double x = 0.15 * uniform(env), y = 0.15 * uniform(env);
    b3CreatePoseCommandSetBasePosition(command, x, y, 0.02);
    b3CreatePoseCommandSetBaseOrientation(command, 0, 0, 0, 1);
    submit(env, command);
}

static void reset(struct environment *env) {
    for (int k = 0; k < JOINTS; k++) {
        handle command = b3CreatePoseCommandInit(env->client, env->robot);
        b3CreatePoseCommandSetJointPosition(env->client, command, joint_index[k],
                                            neutral[k]);
        submit(env, command);
    }
    place(env, env->target);
    place(env, env->cube);
    read_state(env);
}

static void step(struct environment *env) {
    double goal[3], q[JOINTS];
    int body, count;
    for (int k = 0; k < 3; k++) goal[k] = env->ee.position[k] + 0.05 * uniform(env);
    if (goal[2] < 0) goal[2] = 0;
    handle command = b3CalculateInverseKinematicsCommandInit(env->client, env->robot);
    b3CalculateInverseKinematicsAddTargetPositionWithOrientation(command, EE_LINK, goal,
                                                                 downwards);
    b3GetStatusInverseKinematicsJointPositions(submit(env, command), &body, &count, q);
    q[7] = q[8] = 0; /* the gripper is blocked */

    command = b3JointControlCommandInit2(env->client, env->robot, POSITION_VELOCITY_PD);
    for (int k = 0; k < JOINTS; k++) { /* the base has 7 of q and 6 of u */
        b3JointControlSetDesiredPosition(command, 7 + k, q[k]);
        b3JointControlSetKp(command, 6 + k, 0.1);
        b3JointControlSetDesiredVelocity(command, 6 + k, 0);
        b3JointControlSetKd(command, 6 + k, 1);
        b3JointControlSetMaximumForce(command, 6 + k, force[k]);
    }
    submit(env, command);
    for (int k = 0; k < SUBSTEPS; k++)
        submit(env, b3InitStepSimulationCommand(env->client));
    read_state(env);
}

static void *work(void *argument) {
    struct share *share = argument;
    for (int k = 0; k < share->steps; k++)
        for (int i = share->first; i < share->count; i += share->stride) {
            if (k % EPISODE == 0) reset(&share->environments[i]);
            step(&share->environments[i]);
        }
    return NULL;
}

static double now(clockid_t clock) { /* [s] */
    struct timespec time;
    clock_gettime(clock, &time);
    return time.tv_sec + time.tv_nsec * 1e-9;
}

/* The seconds that the steps take, and their processor time. */
void bare_bullet(const char *urdf, int num_envs, int num_threads, int steps,
                 double *wall, double *cpu) {
    struct environment *environments = calloc(num_envs, sizeof *environments);
    struct share *shares = calloc(num_threads, sizeof *shares);
    pthread_t *threads = calloc(num_threads, sizeof *threads);
    for (int i = 0; i < num_envs; i++) build(&environments[i], urdf, i);

    *wall = -now(CLOCK_MONOTONIC);
    *cpu = -now(CLOCK_PROCESS_CPUTIME_ID);
    for (int k = 0; k < num_threads; k++) {
        shares[k] = (struct share){environments, k, num_threads, num_envs, steps};
        pthread_create(&threads[k], NULL, work, &shares[k]);
    }
    for (int k = 0; k < num_threads; k++) pthread_join(threads[k], NULL);
    *wall += now(CLOCK_MONOTONIC);
    *cpu += now(CLOCK_PROCESS_CPUTIME_ID);

    for (int i = 0; i < num_envs; i++) b3DisconnectSharedMemory(environments[i].client);
    free(environments), free(shares), free(threads);
}
