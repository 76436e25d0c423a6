/* Computes setpoints from actions. Computes observations, goals, success, reward and end
   flags from states.

   Robot.setpoint and EpisodeObserver compute the same numbers with torch. They need
   about 40 operations of torch per step, each of which takes 2 to 5 microseconds. The
   functions of this file save most of that time. */

#include "client.h"

#include <math.h>
#include <stdint.h>

/* Clip actions to [-1, 1] and count a step of all environments. Return 0, and count
   nothing, if an action is not finite. */
int environment_begin_step(const float *action, float *clipped, int num_actions,
                           int64_t *step_count, int num_envs) {
    for (int k = 0; k < num_actions; k++) {
        if (!isfinite(action[k])) return 0;
        clipped[k] = action[k] < -1 ? -1 : action[k] > 1 ? 1 : action[k];
    }
    for (int env = 0; env < num_envs; env++) step_count[env]++;
    return 1;
}

/* Whether any flag is true. */
int environment_any(const uint8_t *flags, size_t count) {
    for (size_t k = 0; k < count; k++)
        if (flags[k]) return 1;
    return 0;
}

/* Distance between the fingers; see Robot.fingers_width. */
static double fingers_width(const struct gripper *gripper, doubles row) {
    doubles joints = row + gripper->column;
    double width = joints[0] * gripper->weights[0] + joints[1] * gripper->weights[1];
    return width + gripper->offset;
}

/* Setpoints of all robots for clipped actions; see Robot.setpoint. */
void environment_setpoints(const struct actuation *actuation, doubles state,
                           int num_envs, const float *action, double *setpoint) {
    const struct gripper *gripper = &actuation->gripper;
    for (int env = 0; env < num_envs; env++, state += actuation->row_size) {
        doubles present = state + actuation->column;
        for (int k = 0; k < actuation->num_displaced; k++) {
            float displacement = *action++ * actuation->scale;
            double target = present[k] + displacement;
            if (actuation->has_limits) {
                double lowest = actuation->lowest[k], highest = actuation->highest[k];
                target = target < lowest ? lowest : target > highest ? highest : target;
            }
            *setpoint++ = target;
        }
        for (int k = 0; k < actuation->num_resting; k++)
            *setpoint++ = actuation->resting[k];
        if (!actuation->has_gripper) continue;
        /* Add in float32, as panda-gym does with NumPy 2. */
        float change = *action++ * gripper->scale;
        float width = (float)fingers_width(gripper, state) + change;
        for (int k = 0; k < 2; k++)
            *setpoint++ = gripper->closed[k] + width * gripper->per_width[k];
    }
}

enum { REACHED, MISSED, UNKNOWN };
/* Compare the distance of two goals with the threshold. How torch rounds a distance
   depends on the processor. Return UNKNOWN if the distance is so close to the threshold
   that this rounding could decide, or if the distance is huge or NaN. */
static int compare(const struct observation *observed, const float *achieved_goal,
                   const float *desired_goal) {
    double sum = 0, threshold = observed->distance_threshold;
    for (int k = 0; k < observed->goal_size; k++) {
        float offset = achieved_goal[k] - desired_goal[k];
        sum += (double)offset * offset;
    }
    double distance = sqrt(sum), margin = 1e-5 * threshold + 1e-15;
    if (distance < threshold - margin) return REACHED;
    return distance > threshold + margin && distance < 1e15 ? MISSED : UNKNOWN;
}

/* Observe all environments. Return 1 if success, end flags and the sparse reward are
   valid too. Return 0 if only the observations and goals are valid, in which case the
   caller has to compute the others. */
int environment_observe(const struct observation *observed, doubles state, int num_envs,
                        doubles goal, const int64_t *step_count, float *observation,
                        float *achieved_goal, float *desired_goal, float *reward,
                        uint8_t *success, uint8_t *terminated, uint8_t *truncated,
                        uint8_t *done) {
    int goal_size = observed->goal_size, is_complete = observed->compares_distance;
    for (int env = 0; env < num_envs; env++, state += observed->row_size) {
        for (int k = 0; k < observed->size; k++) {
            int column = observed->columns[k];
            *observation++ = column == WIDTH ? fingers_width(&observed->gripper, state)
                                             : state[column];
        }
        for (int k = 0; k < goal_size; k++) {
            achieved_goal[k] = state[observed->goal_columns[k]];
            desired_goal[k] = *goal++;
        }
        if (is_complete) {
            int answer = compare(observed, achieved_goal, desired_goal);
            int has_begun = step_count[env] > 0; /* no episode ends before its first step */
            is_complete = answer != UNKNOWN;
            success[env] = answer == REACHED;
            reward[env] = answer == REACHED ? -0.0f : -1;
            terminated[env] =
                observed->terminate_on_success && success[env] && has_begun;
            truncated[env] = step_count[env] >= observed->max_episode_steps;
            done[env] = terminated[env] || truncated[env];
        }
        achieved_goal += goal_size, desired_goal += goal_size;
    }
    return is_complete;
}
