/* A step of one client: set the motors of its robot, advance time by substeps, and copy
   the state into the caller's memory. */

#include "client.h"

#include <math.h>
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
    Q_OFFSET = 7, /* joints follow the 7 numbers of the base's pose */
    U_OFFSET = 6  /* joints follow the 6 numbers of the base's velocity */
};

handle client_submit(struct batch *batch, int env, handle command, int expected,
                     const char *action) {
    handle status = batch->bullet->submit(batch->clients[env]->handle, command);
    int answer = status ? batch->bullet->status_type(status) : NO_ANSWER;
    if (answer == expected) return status;
    batch->failures[env] = (struct failure){expected, answer, action};
    return NULL;
}

/* Find the setpoints of the joints: copy them, or solve the inverse kinematics. */
static int find_joints(struct batch *batch, int env, double *joints) {
    const struct functions *bullet = batch->bullet;
    const struct control *control = batch->control;
    doubles setpoint = batch->setpoint + (size_t)env * control->setpoint_size;
    int num_joints = batch->scene->num_joints, arm = control->num_arm_joints;
    if (control->ik_link < 0) {
        memcpy(joints, setpoint, num_joints * sizeof *joints);
        return 1;
    }
    handle command = bullet->ik_init(batch->clients[env]->handle, batch->scene->robot);
    bullet->ik_set_target(command, control->ik_link, setpoint,
                          control->has_orientation ? setpoint + 3
                                                   : control->orientation);
    bullet->ik_set_iterations(command, control->ik_iterations);
    bullet->ik_set_damping(command, num_joints, control->ik_damping);
    handle status =
        client_submit(batch, env, command, CALCULATE_INVERSE_KINEMATICS_COMPLETED,
                      "solve the inverse kinematics");
    if (!status) return 0;
    int body, count;
    bullet->ik_result(status, &body, &count, joints);
    setpoint += control->has_orientation ? 7 : 3;
    memcpy(joints + arm, setpoint, (num_joints - arm) * sizeof *joints);
    return 1;
}

static int set_motors(struct batch *batch, int env, doubles joints) {
    const struct functions *bullet = batch->bullet;
    const struct control *control = batch->control;
    handle client = batch->clients[env]->handle;
    int robot = batch->scene->robot, num_joints = batch->scene->num_joints;
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
        /* The motor must not brake a joint that a torque drives. */
        bullet->motor_set_force(command, U_OFFSET + k,
                                has_torque ? 0 : control->forces[k]);
    }
    return client_submit(batch, env, command, DESIRED_STATE_RECEIVED_COMPLETED,
                         "control joints") != NULL;
}

static int apply_torques(struct batch *batch, int env) {
    const struct functions *bullet = batch->bullet;
    doubles torques = batch->setpoint + (size_t)env * batch->control->setpoint_size;
    handle client = batch->clients[env]->handle;
    handle command = bullet->motor_init(client, batch->scene->robot, TORQUE);
    for (int k = 0; k < batch->control->num_arm_joints; k++)
        bullet->motor_set_torque(command, U_OFFSET + k, torques[k]);
    return client_submit(batch, env, command, DESIRED_STATE_RECEIVED_COMPLETED,
                         "apply torques") != NULL;
}

static int advance(struct batch *batch, int env) {
    struct client *client = batch->clients[env];
    int has_torques = batch->control->arm_mode == TORQUES;
    /* One command serves all substeps: it lies in the client's command buffer, and a
       substep does not overwrite this buffer. Other commands do. */
    handle command = batch->bullet->step_init(client->handle);
    for (int k = 0; k < batch->scene->num_substeps; k++) {
        client->num_detections++;
        if (has_torques) { /* Bullet applies a torque in one substep only */
            if (!apply_torques(batch, env)) return 0;
            command = batch->bullet->step_init(client->handle);
        }
        if (!client_submit(batch, env, command, STEP_FORWARD_SIMULATION_COMPLETED,
                           "step"))
            return 0;
    }
    return 1;
}

struct body_state { /* views of Bullet's memory, valid until the next command */
    doubles q, u, link_poses, link_velocities;
};

static int ask_state(struct batch *batch, int env, int body, struct body_state *state) {
    const struct functions *bullet = batch->bullet;
    handle command = bullet->state_init(batch->clients[env]->handle, body);
    if (body == batch->scene->robot) bullet->state_want_link_velocity(command, 1);
    handle status = client_submit(batch, env, command, ACTUAL_STATE_UPDATE_COMPLETED,
                                  "report a state");
    if (!status) return 0;
    bullet->state_result(status, NULL, NULL, NULL, NULL, NULL, &state->q, &state->u,
                         NULL, NULL, NULL, &state->link_poses, &state->link_velocities);
    return 1;
}

static void copy(double *to, doubles from, int count) {
    memcpy(to, from, count * sizeof *to);
}

void euler_angles(doubles quaternion, double *angles) {
    double x = quaternion[0], y = quaternion[1], z = quaternion[2], w = quaternion[3];
    double sine = -2 * (x * z - w * y);
    if (fabs(sine) >= 0.99999) {
        double side = copysign(1, sine);
        angles[0] = 0;
        angles[1] = side * (3.14159265358979323846 / 2);
        angles[2] = 2 * atan2(-side * x, side * y);
        return;
    }
    double xx = x * x, yy = y * y, zz = z * z, ww = w * w;
    angles[0] = atan2(2 * (y * z + w * x), ww - xx - yy + zz);
    angles[1] = asin(sine);
    angles[2] = atan2(2 * (x * y + w * z), ww + xx - yy - zz);
}

struct row client_row(const struct batch *batch, int env) {
    const struct scene *scene = batch->scene;
    int n = scene->num_joints, num_objects = scene->num_objects;
    int num_object_joints = scene->num_object_joints;
    size_t size = 2 * n + 10 + (7 + STATE_SIZE) * num_objects + 2 * num_object_joints;
    struct row row;
    row.size = size;
    row.joint_position = batch->state + env * size;
    row.joint_velocity = row.joint_position + n;
    row.ee_position = row.joint_velocity + n;
    row.ee_velocity = row.ee_position + 3;
    row.ee_orientation = row.ee_velocity + 3;
    row.object_pose = row.ee_orientation + 4;
    row.object_joint_position = row.object_pose + 7 * num_objects;
    row.object_joint_velocity = row.object_joint_position + num_object_joints;
    row.object_state = row.object_joint_velocity + num_object_joints;
    return row;
}

int client_read(struct batch *batch, int env) {
    const struct scene *scene = batch->scene;
    struct row row = client_row(batch, env);
    struct body_state body;
    if (!ask_state(batch, env, scene->robot, &body)) return 0;
    doubles ee_pose = body.link_poses + 7 * scene->ee_link;
    copy(row.joint_position, body.q + Q_OFFSET, scene->num_joints);
    copy(row.joint_velocity, body.u + U_OFFSET, scene->num_joints);
    copy(row.ee_position, ee_pose, 3);
    copy(row.ee_velocity, body.link_velocities + 6 * scene->ee_link, 3);
    copy(row.ee_orientation, ee_pose + 3, 4);
    for (int k = 0, first = 0; k < scene->num_objects; k++) {
        if (!ask_state(batch, env, scene->objects[k], &body)) return 0;
        int count = scene->object_joint_counts[k];
        double *state = row.object_state + STATE_SIZE * k;
        copy(row.object_pose + 7 * k, body.q, 7);
        copy(state, body.q, 3);
        euler_angles(body.q + 3, state + 3);
        copy(state + VELOCITY, body.u, 6);
        copy(row.object_joint_position + first, body.q + Q_OFFSET, count);
        copy(row.object_joint_velocity + first, body.u + U_OFFSET, count);
        first += count;
    }
    batch->clients[env]->has_diverged = 0;
    for (size_t k = 0; k < row.size; k++)
        if (!isfinite(row.joint_position[k])) batch->clients[env]->has_diverged = 1;
    return 1;
}

int client_is_open(struct batch *batch, int env) {
    int is_closed = batch->clients[env]->handle == NULL;
    batch->failures[env] = (struct failure){is_closed ? CLIENT_CLOSED : 0, 0, NULL};
    return !is_closed;
}

int client_step(struct batch *batch, int env) {
    double joints[MAX_DEGREES_OF_FREEDOM];
    return client_is_open(batch, env) && find_joints(batch, env, joints) &&
           set_motors(batch, env, joints) && advance(batch, env) &&
           client_read(batch, env);
}
