/* What client.c, reset.c and loop.c are told, and what one client does.

   Nothing is linked: Bullet's functions are given by address. native.py declares these
   structs once more, in the same order, and capi.py the functions by full names. */

#ifndef TORCH_PANDA_CLIENT_H
#define TORCH_PANDA_CLIENT_H

#include <stddef.h>
#include <stdint.h>

enum { LOOP_VERSION = 1 }; /* native.py refuses a library of another version */

typedef void *handle;          /* of a client, a command or a status */
typedef const double *doubles; /* to be read */

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

struct link { /* as its body was built */
    int body, link, group, mask, snapshot;
};

struct broad_phase { /* BroadPhase of broad_phase.py: snapshots, and what it counts */
    int64_t num_detections;
    int cycle, away, built, num_links, pair_size, pair[2];
    const struct link *links;
};

struct client {
    handle handle;          /* NULL when it is closed */
    int64_t num_detections; /* how often collisions have been detected */
    int num_substeps;       /* in the present step, so far */
    const struct broad_phase *broad_phase;
};

struct scene { /* the same in every client */
    int robot, ee_link, num_joints, num_objects, num_object_joints, num_markers;
    int num_substeps;
    const int *joints;              /* indices of the robot's */
    const int *objects;             /* body ids */
    const int *object_joint_counts; /* how many each object has */
    const int *object_joints;       /* indices, of the first object, then of the next */
    const int *markers;             /* body ids */
};

enum arm_mode { POSITIONS, VELOCITIES, TORQUES };
struct control { /* MotorControl of control.py */
    int ik_link; /* whose position setpoints give; -1: they are of all joints */
    int num_arm_joints, setpoint_size;
    int turns;    /* whether they give its orientation, too */
    int arm_mode; /* of the arm's joints */
    int ik_iterations;
    double orientation[4], position_gain, velocity_gain;
    doubles forces, ik_damping; /* one a joint */
};

enum { NO_ANSWER = -1, CLIENT_CLOSED = -2, DIVERGED = -3 };
struct failure {
    int expected; /* status code, CLIENT_CLOSED, or DIVERGED, when the state is read but
                     not finite; 0 where nothing has failed */
    int answer;   /* status code, or NO_ANSWER */
    const char *action; /* what Bullet could not do */
};

struct batch { /* many clients of one scene */
    const struct functions *bullet;
    const struct scene *scene;
    struct client *const *clients;
    double *state;            /* a row a client; client_row has the order */
    doubles marker_pose;      /* a row a client, 7 a marker */
    struct failure *failures; /* one a client */

    const struct control *control; /* of the present step, as what follows */
    doubles setpoint;              /* a row a client */
};

enum { STATE_SIZE = 12, VELOCITY = 6 }; /* position, Euler angles, velocity */
struct row { /* a client's */
    double *joint_position, *joint_velocity, *ee_position, *ee_velocity;
    double *ee_orientation, *object_pose, *object_joint_position;
    double *object_joint_velocity, *object_state; /* STATE_SIZE an object */
};

struct row client_row(const struct batch *batch, int env);

/* The following answer whether all has gone well; if not, they note the failure. */

int client_is_open(struct batch *batch, int env);

/* The status; NULL: Bullet could not do it. */
handle client_submit(struct batch *batch, int env, handle command, int expected,
                     const char *action);

/* Copy the state of a client's world into its row. */
int client_read_state(struct batch *batch, int env);

int client_reset(struct batch *batch, int env);

/* Take so many substeps of a step; answer whether more of them are to be taken. */
int client_take_piece(struct batch *batch, int env, int piece);

/* LOOP_VERSION of the sources from which the library was compiled. */
int loop_version(void);

/* Roll, pitch and yaw of a quaternion xyzw; euler.py says more. */
void euler_angles(doubles quaternion, double *angles);

#endif
