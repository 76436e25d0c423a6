/* Structs and functions that the C files share.

   The library does not link to Bullet: the caller passes the addresses of Bullet's
   functions, whose full names are in capi.py. native.py declares the same structs. */

#ifndef TORCH_PANDA_CLIENT_H
#define TORCH_PANDA_CLIENT_H

#include <stddef.h>
#include <stdint.h>

enum { LOOP_VERSION = 6 }; /* native.py refuses a library of another version */

typedef void *handle;          /* of a client, a command or a status */
typedef const double *doubles; /* input */

struct functions {
    handle (*submit)(handle client, handle command);
    int (*status_type)(handle status);
    handle (*ik_init)(handle client, int body);
    void (*ik_set_target)(handle command, int link, doubles position,
                          doubles orientation);
    void (*ik_set_iterations)(handle command, int most);
    void (*ik_set_damping)(handle command, int num_joints, doubles damping);
    int (*ik_result)(handle status, int *body, int *count, double *positions);
    handle (*motor_init)(handle client, int body, int mode);
    int (*motor_set_position)(handle command, int q_index, double position);
    int (*motor_set_velocity)(handle command, int u_index, double velocity);
    int (*motor_set_torque)(handle command, int u_index, double torque);
    int (*motor_set_kp)(handle command, int u_index, double gain);
    int (*motor_set_kd)(handle command, int u_index, double gain);
    int (*motor_set_force)(handle command, int u_index, double force);
    handle (*step_init)(handle client);
    handle (*state_init)(handle client, int body);
    int (*state_want_link_velocity)(handle command, int wanted);
    int (*state_result)(handle status, int *body, int *num_links, int *num_q,
                        int *num_u, doubles *root_frame, doubles *q, doubles *u,
                        doubles *joint_forces, doubles *link_frames,
                        doubles *motor_forces, doubles *link_poses,
                        doubles *link_velocities);
    handle (*load_init)(handle client);
    int (*load_set_snapshot)(handle command, int snapshot);
    handle (*filter_init)(handle client);
    void (*filter_set_group_mask)(handle command, int body, int link, int group,
                                  int mask);
    handle (*detect_init)(handle client);
    handle (*pose_init)(handle client, int body);
    int (*pose_set_position)(handle command, double x, double y, double z);
    int (*pose_set_orientation)(handle command, double x, double y, double z, double w);
    int (*pose_set_linear_velocity)(handle command, doubles velocity);
    int (*pose_set_angular_velocity)(handle command, doubles velocity);
    int (*pose_set_joint_position)(handle client, handle command, int joint,
                                   double position);
    int (*pose_set_joint_velocity)(handle client, handle command, int joint,
                                   double velocity);
};

struct link { /* _Link of broad_phase.py */
    int body, link, group, mask, snapshot;
};

/* BroadPhase of broad_phase.py, which explains how a reset restores the broad phase.
   `num_detections` is the number of collision detections when the scene was built; a
   reset restores it modulo `cycle`. `away` and `built` are snapshots with the bodies far
   away and as built. `pair` has the first two bodies, whose overlap brings the cursor
   back to the start. */
struct broad_phase {
    int64_t num_detections;
    int cycle, away, built, num_links, pair_size, pair[2];
    const struct link *links;
};

struct client {
    handle handle;          /* NULL if the client is closed */
    int64_t num_detections; /* collision detections so far */
    int num_substeps;       /* substeps of the present step so far */
    const struct broad_phase *broad_phase;
};

struct scene { /* the same in every client */
    int robot, ee_link, num_joints, num_objects, num_object_joints, num_markers;
    int num_substeps;
    const int *joints;              /* indices of the robot's movable joints */
    const int *objects;             /* body ids */
    const int *object_joint_counts; /* number of movable joints per object */
    const int *object_joints;       /* their indices, object by object */
    const int *markers;             /* body ids */
};

enum arm_mode { POSITIONS, VELOCITIES, TORQUES };
struct control { /* MotorControl of control.py */
    int ik_link; /* link whose target setpoints contain; -1 for joints */
    int num_arm_joints, setpoint_size;
    int has_orientation; /* whether setpoints contain the orientation of ik_link */
    int arm_mode;        /* enum arm_mode */
    int ik_iterations;
    double orientation[4], position_gain, velocity_gain;
    doubles forces, ik_damping; /* a number per joint */
};

enum { NO_ANSWER = -1, CLIENT_CLOSED = -2, DIVERGED = -3 };
struct failure {
    int expected; /* expected status code, CLIENT_CLOSED, DIVERGED if the state is not
                     finite, or 0 if nothing failed */
    int answer;   /* status code of Bullet's answer, or NO_ANSWER */
    const char *action; /* the action that failed */
};

struct batch { /* many clients of one scene */
    const struct functions *bullet;
    const struct scene *scene;
    struct client *const *clients;
    double *state;            /* a row per client, in the order of client_row */
    doubles marker_pose;      /* a row per client: 7 numbers per marker */
    struct failure *failures; /* one per client */

    /* For the present step: */
    const struct control *control;
    doubles setpoint; /* a row per client */
};

/* An object's state is position (3), Euler angles (3) and velocity (6). */
enum { STATE_SIZE = 12, VELOCITY = 6 };
struct row { /* parts of a client's row of the state */
    double *joint_position, *joint_velocity, *ee_position, *ee_velocity;
    double *ee_orientation, *object_pose, *object_joint_position;
    double *object_joint_velocity, *object_state; /* STATE_SIZE per object */
};

struct row client_row(const struct batch *batch, int env);

/* The following functions return 1 on success. Otherwise they return 0 or NULL and store
   the failure. */

int client_is_open(struct batch *batch, int env);

/* Submit a command and return its status if the code is the expected one. */
handle client_submit(struct batch *batch, int env, handle command, int expected,
                     const char *action);

/* Copy the state of a client into its row. */
int client_read_state(struct batch *batch, int env);

/* Restore a client's broad phase, move its bodies to the state in its row, and copy the
   resulting state into the row. */
int client_reset(struct batch *batch, int env);

/* Take up to `piece` substeps of a step. Return 1 if substeps remain, else 0. */
int client_take_piece(struct batch *batch, int env, int piece);

/* LOOP_VERSION of the sources from which the library was compiled. */
int loop_version(void);

/* Roll, pitch and yaw of a quaternion xyzw; see euler.py. */
void euler_angles(doubles quaternion, double *angles);

#endif
