/* A vector step of many clients, in threads of its own and without Python.

   A step of one client sets the motors of its robot, advances time by some substeps,
   and copies the state of its world into the caller's memory. Clients are drawn by
   whichever thread is free; the caller's takes part, and returns when all are done.

   Nothing is linked: Bullet's functions are given by address. native.py declares these
   structs once more, in the same order, and capi.py the functions by their full names.
   simulation.py does the same in Python where this file was not compiled, and both
   give the same numbers. */

#define _POSIX_C_SOURCE 200809L

#include <fenv.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum {
    /* enum EnumSharedMemoryServerStatus */
    ACTUAL_STATE_UPDATE_COMPLETED = 21,
    DESIRED_STATE_RECEIVED_COMPLETED = 25,
    STEP_FORWARD_SIMULATION_COMPLETED = 26,
    CALCULATE_INVERSE_KINEMATICS_COMPLETED = 43,

    TORQUE = 1,                   /* enum for b3JointControlCommandInit2 */
    POSITION_VELOCITY_PD = 2,
    MAX_DEGREES_OF_FREEDOM = 128, /* of a body */
    Q_OFFSET = 7,                 /* joints follow the base: 7 of its pose, */
    U_OFFSET = 6,                 /* 6 of its velocity */
    STACK_SIZE = 8 << 20          /* of a thread: as on Linux; macOS gives less */
};

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

struct loop {
    const struct functions *bullet;
    const struct scene *scene;
    struct client *const *clients;
    double *state;            /* a row a client; read_state has the order */
    struct failure *failures; /* one a client */

    const struct control *control; /* of the present step, as what follows */
    doubles setpoint;              /* a row a client */
    const int *envs;               /* which clients */
    int num_envs, num_drawn, num_done, num_failed;

    pthread_mutex_t mutex; /* of all that changes */
    pthread_cond_t begun, done;
    int is_over;
    int num_threads; /* beside the caller's */
    pthread_t threads[];
};

/* ---- one client; parts of its step answer whether they have gone well ------------ */

static handle submit(struct loop *loop, int env, handle command, int expected) {
    handle status = loop->bullet->submit(loop->clients[env]->handle, command);
    int answer = status ? loop->bullet->status_type(status) : NO_ANSWER;
    if (answer == expected) return status;
    loop->failures[env] = (struct failure){expected, answer};
    return NULL;
}

static int find_joints(struct loop *loop, int env, double *joints) {
    const struct functions *bullet = loop->bullet;
    const struct control *control = loop->control;
    doubles setpoint = loop->setpoint + (size_t)env * control->setpoint_size;
    int num_joints = loop->scene->num_joints, arm = control->num_arm_joints;
    if (control->ik_link < 0) {
        memcpy(joints, setpoint, num_joints * sizeof *joints);
        return 1;
    }
    handle command = bullet->ik_init(loop->clients[env]->handle, loop->scene->robot);
    bullet->ik_set_target(command, control->ik_link, setpoint,
                          control->turns ? setpoint + 3 : control->orientation);
    handle status = submit(loop, env, command, CALCULATE_INVERSE_KINEMATICS_COMPLETED);
    if (!status) return 0;
    int body, count;
    bullet->ik_result(status, &body, &count, joints);
    setpoint += control->turns ? 7 : 3;
    memcpy(joints + arm, setpoint, (num_joints - arm) * sizeof *joints);
    return 1;
}

static int set_motors(struct loop *loop, int env, doubles joints) {
    const struct functions *bullet = loop->bullet;
    const struct control *control = loop->control;
    handle client = loop->clients[env]->handle;
    int robot = loop->scene->robot, num_joints = loop->scene->num_joints;
    handle command = bullet->motor_init(client, robot, POSITION_VELOCITY_PD);
    int arm = control->num_arm_joints, mode = control->arm_mode;
    for (int k = 0; k < num_joints; k++) {
        int joint_mode = k < arm ? mode : POSITIONS, has_torque = joint_mode == TORQUES;
        if (joint_mode == POSITIONS) {
            bullet->motor_set_position(command, Q_OFFSET + k, joints[k]);
            bullet->motor_set_kp(command, U_OFFSET + k, control->position_gain);
        } else {
            double velocity = has_torque ? 0 : joints[k];
            bullet->motor_set_velocity(command, U_OFFSET + k, velocity);
            bullet->motor_set_kp(command, U_OFFSET + k, 0);
        }
        bullet->motor_set_kd(command, U_OFFSET + k, control->velocity_gain);
        /* Where torques are applied, motors must not brake. */
        bullet->motor_set_force(command, U_OFFSET + k,
                                has_torque ? 0 : control->forces[k]);
    }
    return submit(loop, env, command, DESIRED_STATE_RECEIVED_COMPLETED) != NULL;
}

static int apply_torques(struct loop *loop, int env, doubles torques) {
    const struct functions *bullet = loop->bullet;
    handle client = loop->clients[env]->handle;
    handle command = bullet->motor_init(client, loop->scene->robot, TORQUE);
    for (int k = 0; k < loop->control->num_arm_joints; k++)
        bullet->motor_set_torque(command, U_OFFSET + k, torques[k]);
    return submit(loop, env, command, DESIRED_STATE_RECEIVED_COMPLETED) != NULL;
}

static int advance(struct loop *loop, int env, doubles joints) {
    struct client *client = loop->clients[env];
    int has_torques = loop->control->arm_mode == TORQUES;
    /* A client has one command buffer, and stepping leaves it as it was. */
    handle command = loop->bullet->step_init(client->handle);
    for (int k = 0; k < loop->scene->num_substeps; k++) {
        client->num_detections++;
        if (has_torques) { /* which Bullet forgets when it has stepped */
            if (!apply_torques(loop, env, joints)) return 0;
            command = loop->bullet->step_init(client->handle);
        }
        if (!submit(loop, env, command, STEP_FORWARD_SIMULATION_COMPLETED)) return 0;
    }
    return 1;
}

struct body_state { /* views of Bullet's memory, until the client's next command */
    doubles q, u, link_poses, link_velocities;
};

static int ask_state(struct loop *loop, int env, int body, struct body_state *state) {
    const struct functions *bullet = loop->bullet;
    handle command = bullet->state_init(loop->clients[env]->handle, body);
    if (body == loop->scene->robot) bullet->state_want_link_velocity(command, 1);
    handle status = submit(loop, env, command, ACTUAL_STATE_UPDATE_COMPLETED);
    if (!status) return 0;
    bullet->state_result(status, NULL, NULL, NULL, NULL, NULL, &state->q, &state->u,
                         NULL, NULL, NULL, &state->link_poses, &state->link_velocities);
    return 1;
}

static double *copy(double *to, doubles from, int count) {
    memcpy(to, from, count * sizeof *to);
    return to + count;
}

/* Fill a client's row: joint positions and velocities, position, velocity and
   orientation of the end-effector; poses (7 each), then velocities (6 each) of the
   objects, then positions and velocities of their joints. */
static int read_state(struct loop *loop, int env) {
    const struct scene *scene = loop->scene;
    int n = scene->num_joints, num_objects = scene->num_objects;
    int num_object_joints = scene->num_object_joints;
    int size = 2 * n + 10 + 13 * num_objects + 2 * num_object_joints;
    double *row = loop->state + (size_t)env * size;
    struct body_state body;
    if (!ask_state(loop, env, scene->robot, &body)) return 0;
    row = copy(row, body.q + Q_OFFSET, n);
    row = copy(row, body.u + U_OFFSET, n);
    row = copy(row, body.link_poses + 7 * scene->ee_link, 3);
    row = copy(row, body.link_velocities + 6 * scene->ee_link, 3);
    row = copy(row, body.link_poses + 7 * scene->ee_link + 3, 4);
    double *joints = row + 13 * num_objects;
    for (int k = 0; k < num_objects; k++) {
        if (!ask_state(loop, env, scene->objects[k], &body)) return 0;
        copy(row + 7 * k, body.q, 7);
        copy(row + 7 * num_objects + 6 * k, body.u, 6);
        copy(joints + num_object_joints, body.u + U_OFFSET, scene->object_joints[k]);
        joints = copy(joints, body.q + Q_OFFSET, scene->object_joints[k]);
    }
    return 1;
}

static int step_client(struct loop *loop, int env) {
    double joints[MAX_DEGREES_OF_FREEDOM];
    int is_closed = loop->clients[env]->handle == NULL;
    loop->failures[env] = (struct failure){is_closed ? CLIENT_CLOSED : 0, 0};
    return !is_closed && find_joints(loop, env, joints) &&
           set_motors(loop, env, joints) && advance(loop, env, joints) && read_state(loop, env);
}

/* ---- threads --------------------------------------------------------------------- */

/* Step clients until none is left to be drawn; the mutex is held before and after. */
static void take_part(struct loop *loop) {
    while (loop->num_drawn < loop->num_envs) {
        int env = loop->envs[loop->num_drawn++];
        pthread_mutex_unlock(&loop->mutex);
        int has_failed = !step_client(loop, env);
        pthread_mutex_lock(&loop->mutex);
        loop->num_failed += has_failed;
        if (++loop->num_done == loop->num_envs) pthread_cond_signal(&loop->done);
    }
}

static void *serve(void *argument) {
    struct loop *loop = argument;
    fesetenv(FE_DFL_ENV); /* and not its creator's */
    pthread_mutex_lock(&loop->mutex);
    while (!loop->is_over) {
        take_part(loop);
        pthread_cond_wait(&loop->begun, &loop->mutex);
    }
    pthread_mutex_unlock(&loop->mutex);
    return NULL;
}

/* Start the threads, or as many as the system grants; NULL: there is no memory. What
   the pointers point to must outlive the loop. */
struct loop *loop_create(const struct functions *bullet, const struct scene *scene,
                         struct client *const *clients, double *state,
                         struct failure *failures, int num_threads) {
    struct loop *loop = calloc(1, sizeof *loop + num_threads * sizeof(pthread_t));
    if (!loop) return NULL;
    loop->bullet = bullet, loop->scene = scene, loop->clients = clients;
    loop->state = state, loop->failures = failures;
    pthread_mutex_init(&loop->mutex, NULL);
    pthread_cond_init(&loop->begun, NULL);
    pthread_cond_init(&loop->done, NULL);
    pthread_attr_t attributes;
    pthread_attr_init(&attributes);
    pthread_attr_setstacksize(&attributes, STACK_SIZE);
    sigset_t all, before; /* signals are for Python's threads alone */
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    for (; loop->num_threads < num_threads - 1; loop->num_threads++) {
        pthread_t *thread = &loop->threads[loop->num_threads];
        if (pthread_create(thread, &attributes, serve, loop)) break;
    }
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    pthread_attr_destroy(&attributes);
    return loop;
}

/* Step some clients, of which none may be named twice; return how many have failed. */
int loop_step(struct loop *loop, const struct control *control, doubles setpoint,
              const int *envs, int num_envs) {
    fenv_t before; /* of the caller, who may flush denormal numbers to zero */
    fegetenv(&before);
    fesetenv(FE_DFL_ENV);
    pthread_mutex_lock(&loop->mutex);
    loop->control = control, loop->setpoint = setpoint;
    loop->envs = envs, loop->num_envs = num_envs;
    loop->num_drawn = loop->num_done = loop->num_failed = 0;
    pthread_cond_broadcast(&loop->begun);
    take_part(loop);
    while (loop->num_done < num_envs) pthread_cond_wait(&loop->done, &loop->mutex);
    pthread_mutex_unlock(&loop->mutex);
    fesetenv(&before);
    return loop->num_failed;
}

/* End the threads. A forked child, which has none, must not call this. */
void loop_destroy(struct loop *loop) {
    pthread_mutex_lock(&loop->mutex);
    loop->is_over = 1;
    pthread_cond_broadcast(&loop->begun);
    pthread_mutex_unlock(&loop->mutex);
    for (int k = 0; k < loop->num_threads; k++) pthread_join(loop->threads[k], NULL);
    pthread_mutex_destroy(&loop->mutex);
    pthread_cond_destroy(&loop->begun);
    pthread_cond_destroy(&loop->done);
    free(loop);
}
