/* What client.c and loop.c are told, and what one client does.

   Nothing is linked: Bullet's functions are given by address. native.py declares these
   structs once more, in the same order, and capi.py the functions by full names. */

#ifndef TORCH_PANDA_CLIENT_H
#define TORCH_PANDA_CLIENT_H

#include <stdint.h>

typedef void *handle;          /* of a client, a command or a status */
typedef const double *doubles; /* to be read */

struct functions {
    handle (*submit)(handle client, handle command);
    int (*status_type)(handle status);
    handle (*ik_init)(handle client, int body);
    void (*ik_set_target)(handle command, int link, doubles position,
                          doubles orientation);
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
};

struct client {
    handle handle;          /* NULL when it is closed */
    int64_t num_detections; /* how often collisions have been detected */
    int num_substeps;       /* in the present step, so far */
};

struct scene { /* the same in every client */
    int robot, ee_link, num_joints, num_objects, num_object_joints, num_substeps;
    const int *objects;       /* body ids */
    const int *object_joints; /* how many each object has */
};

enum arm_mode { POSITIONS, VELOCITIES, TORQUES };
struct control { /* MotorControl of control.py */
    int ik_link; /* whose position setpoints give; -1: they are of all joints */
    int num_arm_joints, setpoint_size;
    int turns;    /* whether they give its orientation, too */
    int arm_mode; /* of the arm's joints */
    double orientation[4], position_gain, velocity_gain;
    doubles forces; /* one a joint */
};

enum { NO_ANSWER = -1, CLIENT_CLOSED = -2 };
struct failure {
    int expected; /* status code, or CLIENT_CLOSED; 0 where nothing has failed */
    int answer;   /* status code, or NO_ANSWER */
};

struct batch { /* many clients of one scene */
    const struct functions *bullet;
    const struct scene *scene;
    struct client *const *clients;
    double *state;            /* a row a client; read_state has the order */
    struct failure *failures; /* one a client */

    const struct control *control; /* of the present step, as what follows */
    doubles setpoint;              /* a row a client */
};

/* Take so many substeps of a step; answer whether more of them are to be taken. */
int client_take_piece(struct batch *batch, int env, int piece);

/* Roll, pitch and yaw of a quaternion xyzw; euler.py says more. */
void euler_angles(doubles quaternion, double *angles);

#endif
