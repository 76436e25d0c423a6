/* Bullet's functions, as write_functions.py writes them from capi.py. */

#ifndef TORCH_PANDA_FUNCTIONS_H
#define TORCH_PANDA_FUNCTIONS_H

typedef void *handle;          /* of a client, a command or a status */
typedef const double *doubles; /* input */

struct functions {
    handle (*connect_direct)(void);
    void (*disconnect)(handle);
    handle (*submit)(handle, handle);
    int (*status_type)(handle);
    handle (*physics_init)(handle);
    int (*physics_set_gravity)(handle, double, double, double);
    int (*physics_set_timestep)(handle, double);
    int (*physics_set_solver_iterations)(handle, int);
    int (*physics_set_residual_threshold)(handle, double);
    handle (*step_init)(handle);
    handle (*detect_init)(handle);
    handle (*urdf_init)(handle, const char *);
    int (*urdf_set_position)(handle, double, double, double);
    int (*urdf_set_orientation)(handle, double, double, double, double);
    int (*urdf_set_fixed_base)(handle, int);
    int (*urdf_set_flags)(handle, int);
    int (*status_body)(handle);
    handle (*shape_init)(handle);
    int (*shape_add_box)(handle, doubles);
    int (*shape_add_sphere)(handle, double);
    int (*shape_add_cylinder)(handle, double, double);
    int (*status_shape)(handle);
    handle (*body_init)(handle);
    int (*body_set_base)(handle, double, int, int, doubles, doubles, doubles, doubles);
    handle (*dynamics_init)(handle);
    int (*dynamics_set_mass)(handle, int, int, double);
    int (*dynamics_set_restitution)(handle, int, int, double);
    int (*dynamics_set_joint_damping)(handle, int, int, double);
    int (*dynamics_set_lateral_friction)(handle, int, int, double);
    int (*dynamics_set_rolling_friction)(handle, int, int, double);
    int (*dynamics_set_spinning_friction)(handle, int, int, double);
    handle (*dynamics_info_init)(handle, int, int);
    int (*dynamics_info)(handle, void *);
    int (*joint_count)(handle, int);
    int (*joint_info)(handle, int, int, void *);
    handle (*filter_init)(handle);
    void (*filter_set_group_mask)(handle, int, int, int, int);
    handle (*pose_init)(handle, int);
    int (*pose_set_position)(handle, double, double, double);
    int (*pose_set_orientation)(handle, double, double, double, double);
    int (*pose_set_linear_velocity)(handle, doubles);
    int (*pose_set_angular_velocity)(handle, doubles);
    int (*pose_set_joint_position)(handle, handle, int, double);
    int (*pose_set_joint_velocity)(handle, handle, int, double);
    handle (*save_init)(handle);
    int (*status_snapshot)(handle);
    handle (*load_init)(handle);
    int (*load_set_snapshot)(handle, int);
    handle (*motor_init)(handle, int, int);
    int (*motor_set_position)(handle, int, double);
    int (*motor_set_velocity)(handle, int, double);
    int (*motor_set_torque)(handle, int, double);
    int (*motor_set_kp)(handle, int, double);
    int (*motor_set_kd)(handle, int, double);
    int (*motor_set_force)(handle, int, double);
    handle (*ik_init)(handle, int);
    void (*ik_set_target)(handle, int, doubles, doubles);
    void (*ik_set_iterations)(handle, int);
    void (*ik_set_damping)(handle, int, doubles);
    int (*ik_result)(handle, int *, int *, double *);
    handle (*state_init)(handle, int);
    int (*state_want_link_velocity)(handle, int);
    int (*state_result)(handle, int *, int *, int *, int *, doubles *, doubles *,
        doubles *, doubles *, doubles *, doubles *, doubles *, doubles *);
    handle (*contact_init)(handle);
    void (*contact_result)(handle, void *);
    handle (*sensor_init)(handle, int);
    int (*sensor_enable_wrench)(handle, int, int);
    int (*physics_set_joint_feedback)(handle, int);
    handle (*visual_init)(handle);
    int (*visual_add_box)(handle, doubles);
    int (*visual_add_sphere)(handle, double);
    int (*visual_add_cylinder)(handle, double, double);
    int (*visual_add_mesh)(handle, handle, doubles, doubles, int, int *, int, doubles,
        int, doubles, int);
    void (*visual_set_color)(handle, int, doubles);
    void (*visual_set_specular)(handle, int, doubles);
    int (*status_visual)(handle);
    handle (*texture_init)(handle, const char *);
    int (*status_texture)(handle);
    handle (*visual_update_init)(handle, int, int, int);
    void (*visual_update_texture)(handle, int);
    void (*view_matrix)(float *, float, float, float, float, int, float *);
    void (*view_matrix_from_positions)(float *, float *, float *, float *);
    void (*projection_matrix)(float, float, float, float, float *);
    handle (*camera_init)(handle);
    void (*camera_set_matrices)(handle, float *, float *);
    void (*camera_set_size)(handle, int, int);
    void (*camera_set_shadow)(handle, int);
    void (*camera_set_flags)(handle, int);
    void (*camera_result)(handle, void *);
    handle (*plugin_init)(handle);
    void (*plugin_set_path)(handle, const char *);
    void (*plugin_set_suffix)(handle, const char *);
    int (*status_plugin)(handle);
    handle (*connect_window)(int, void *);
    handle (*window_init)(handle);
    void (*window_set_flag)(handle, int, int);
    void (*window_set_camera)(handle, float, float, float, float *);
};

#endif
