/* Structs and functions that the C files share.

   The library does not link to Bullet: the caller passes the addresses of Bullet's
   functions. structs.py declares the same structs. */

#ifndef TORCH_PANDA_CLIENT_H
#define TORCH_PANDA_CLIENT_H

#include <stddef.h>
#include <stdint.h>

#include "functions.h"

/* A link, and how a reset inserts it into the broad phase. */
struct link {
    int body, link;
    int group, mask; /* of its collision filter */
    int snapshot;    /* to load before the link is inserted */
};

/* How to restore a client's broad phase; broad_phase.py plans this. */
struct broad_phase {
    int64_t num_detections; /* collision detections when the scene was built */
    int cycle;              /* a reset restores this number modulo `cycle` */
    int away, built;        /* snapshots with the bodies far away, and as built */
    int num_links;
    const struct link *links; /* of all bodies, in the order in which they were built */
    int pair_size, pair[2]; /* the first two bodies, or the only one */
};

struct client {
    handle handle;          /* NULL if the client is closed */
    int64_t num_detections; /* collision detections so far */
    int has_diverged;       /* whether the state was not finite when it was last read */
    const struct broad_phase *broad_phase;
};

struct scene { /* the same in every client */
    int robot, ee_link, num_joints, num_objects, num_object_joints, num_markers;
    int num_substeps;               /* of a step */
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

enum { NO_ANSWER = -1, CLIENT_CLOSED = -2 };
struct failure {
    int expected;       /* status code of success, CLIENT_CLOSED if the client was closed
                           before the command, or 0 if nothing failed */
    int answer;         /* status code of Bullet's answer, or NO_ANSWER */
    const char *action; /* the action that failed */
};

struct batch { /* many clients of one scene */
    const struct functions *bullet;
    const struct scene *scene;
    struct client *const *clients;
    double *state;            /* a row per client, in the order of client_row */
    doubles marker_pose;      /* a row per client: 7 numbers per marker */
    struct failure *failures; /* one per client */
    const struct control *control;
    doubles setpoint; /* a row per client */
};

/* An object's state is position (3), Euler angles (3) and velocity (6). */
enum { STATE_SIZE = 12, VELOCITY = 6 };
struct row { /* parts of a client's row of the state */
    size_t size; /* of the whole row, which begins with joint_position */
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
int client_read(struct batch *batch, int env);

/* Set the motors of a client's robot, take all substeps of a step, and copy the state
   into its row. */
int client_step(struct batch *batch, int env);

/* Move a client's bodies to where they were built, and restore its broad phase. */
int client_restore(struct batch *batch, int env);

/* Restore a client, move its bodies to the state in its row, and copy the resulting
   state into the row. */
int client_reset(struct batch *batch, int env);

/* Hash of the sources from which the library was compiled. */
uint32_t loop_version(void);

/* Roll, pitch and yaw of a quaternion xyzw; see rotations.py. */
void euler_angles(doubles quaternion, double *angles);

#endif
