/* A reset of one client: restore its broad phase, place its bodies, and copy its state.

   A reset has about 70 commands, which take 0.08 ms. */

#include "client.h"

enum {
    /* enum EnumSharedMemoryServerStatus */
    CLIENT_COMMAND_COMPLETED = 2,
    RESTORE_STATE_COMPLETED = 95,
    PERFORM_COLLISION_DETECTION_COMPLETED = 112,

    DYNAMIC_GROUP = 1, /* collision group and mask of links that can move */
    DYNAMIC_MASK = -1
};

static int load_snapshot(struct batch *batch, int env, int snapshot) {
    handle command = batch->bullet->load_init(batch->clients[env]->handle);
    batch->bullet->load_set_snapshot(command, snapshot);
    return client_submit(batch, env, command, RESTORE_STATE_COMPLETED,
                         "load a state") != NULL;
}

static int set_filter(struct batch *batch, int env, int body, int link, int group,
                      int mask) {
    handle command = batch->bullet->filter_init(batch->clients[env]->handle);
    batch->bullet->filter_set_group_mask(command, body, link, group, mask);
    return client_submit(batch, env, command, CLIENT_COMMAND_COMPLETED,
                         "set a collision filter") != NULL;
}

static int detect(struct batch *batch, int env, int count) {
    struct client *client = batch->clients[env];
    handle command = batch->bullet->detect_init(client->handle);
    client->num_detections += count;
    for (; count > 1; count--) batch->bullet->submit(client->handle, command);
    return count == 0 ||
           client_submit(batch, env, command, PERFORM_COLLISION_DETECTION_COMPLETED,
                         "detect collisions") != NULL;
}

/* All bodies are first moved far away. Then one link after another is inserted at the
   pose at which it was built, in the order in which the links were built. Its old
   overlaps and contacts are lost. */
int client_restore(struct batch *batch, int env) {
    const struct client *client = batch->clients[env];
    const struct broad_phase *broad_phase = client->broad_phase;
    if (!load_snapshot(batch, env, broad_phase->away)) return 0;
    /* All bodies are at the same position now, so filter out all pairs of links. */
    for (int k = 0; k < broad_phase->num_links; k++) {
        const struct link *link = &broad_phase->links[k];
        if (!set_filter(batch, env, link->body, link->link, 0, 0)) return 0;
    }
    /* Move the cursor back to the start of the list of pairs. A detection advances the
       cursor modulo the number of pairs, so with exactly one pair it becomes 0. */
    for (int k = 0; k < broad_phase->pair_size; k++)
        if (!set_filter(batch, env, broad_phase->pair[k], -1, DYNAMIC_GROUP,
                        DYNAMIC_MASK))
            return 0;
    if (!detect(batch, env, 1)) return 0;
    for (int k = 0; k < broad_phase->pair_size; k++)
        if (!set_filter(batch, env, broad_phase->pair[k], -1, 0, 0)) return 0;
    /* Run detections until their number is that after building, modulo the cycle. While
       nothing overlaps, a detection takes about 1 us. */
    int cycle = broad_phase->cycle;
    int num_since_built =
        (int)((client->num_detections - broad_phase->num_detections) % cycle);
    if (!detect(batch, env, (cycle - num_since_built) % cycle)) return 0;
    for (int k = 0; k < broad_phase->num_links; k++) {
        const struct link *link = &broad_phase->links[k];
        if (!load_snapshot(batch, env, link->snapshot)) return 0;
        if (!set_filter(batch, env, link->body, link->link, link->group, link->mask))
            return 0;
    }
    return load_snapshot(batch, env, broad_phase->built);
}

static int set_joints(struct batch *batch, int env, int body, int count,
                      const int *joints, doubles positions, doubles velocities) {
    const struct functions *bullet = batch->bullet;
    handle client = batch->clients[env]->handle;
    handle command = bullet->pose_init(client, body);
    for (int k = 0; k < count; k++) {
        bullet->pose_set_joint_position(client, command, joints[k], positions[k]);
        bullet->pose_set_joint_velocity(client, command, joints[k], velocities[k]);
    }
    return client_submit(batch, env, command, CLIENT_COMMAND_COMPLETED,
                         "set joints") != NULL;
}

static int set_base(struct batch *batch, int env, int body, doubles pose,
                    doubles velocity) {
    const struct functions *bullet = batch->bullet;
    handle command = bullet->pose_init(batch->clients[env]->handle, body);
    bullet->pose_set_linear_velocity(command, velocity);
    bullet->pose_set_angular_velocity(command, velocity + 3);
    bullet->pose_set_position(command, pose[0], pose[1], pose[2]);
    bullet->pose_set_orientation(command, pose[3], pose[4], pose[5], pose[6]);
    return client_submit(batch, env, command, CLIENT_COMMAND_COMPLETED,
                         "set a base pose") != NULL;
}

/* One by one and in panda-gym's order, because the state of the broad phase depends on
   the order. */
static int place(struct batch *batch, int env) {
    static const double at_rest[6];
    const struct scene *scene = batch->scene;
    struct row row = client_row(batch, env);
    for (int k = 0; k < scene->num_joints; k++)
        if (!set_joints(batch, env, scene->robot, 1, scene->joints + k,
                        row.joint_position + k, row.joint_velocity + k))
            return 0;
    doubles marker_pose = batch->marker_pose + (size_t)env * 7 * scene->num_markers;
    for (int k = 0; k < scene->num_markers; k++)
        if (!set_base(batch, env, scene->markers[k], marker_pose + 7 * k, at_rest))
            return 0;
    for (int k = 0; k < scene->num_objects; k++)
        if (!set_base(batch, env, scene->objects[k], row.object_pose + 7 * k,
                      row.object_state + STATE_SIZE * k + VELOCITY))
            return 0;
    for (int k = 0, first = 0; k < scene->num_objects; k++) {
        int count = scene->object_joint_counts[k];
        if (count && !set_joints(batch, env, scene->objects[k], count,
                                 scene->object_joints + first,
                                 row.object_joint_position + first,
                                 row.object_joint_velocity + first))
            return 0;
        first += count;
    }
    return 1;
}

int client_reset(struct batch *batch, int env) {
    return client_is_open(batch, env) && client_restore(batch, env) &&
           place(batch, env) && client_read(batch, env);
}
