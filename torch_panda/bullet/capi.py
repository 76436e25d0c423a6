"""Declarations of Bullet's C API, which pybullet's extension module exports.

Every statement binds one function of ``PhysicsClientC_API.h`` (pybullet 3.2.7) with its
name, its result type and its argument types. This file has no logic. C code calls the
same functions through a table; see ``structs.py``.
"""

import ctypes
import sys
from ctypes import (
    POINTER,
    c_char,
    c_char_p,
    c_double,
    c_float,
    c_int,
    c_ubyte,
    c_void_p,
)
from functools import partial

from torch_panda.bullet.library import CHEAP, WORK, bind

# enum EnumSharedMemoryServerStatus
CMD_CLIENT_COMMAND_COMPLETED = 2
CMD_URDF_LOADING_COMPLETED = 6
CMD_ACTUAL_STATE_UPDATE_COMPLETED = 21
CMD_DESIRED_STATE_RECEIVED_COMPLETED = 25
CMD_STEP_FORWARD_SIMULATION_COMPLETED = 26
CMD_CAMERA_IMAGE_COMPLETED = 28
CMD_CONTACT_POINT_INFORMATION_COMPLETED = 39
CMD_CALCULATE_INVERSE_KINEMATICS_COMPLETED = 43
CMD_VISUAL_SHAPE_UPDATE_COMPLETED = 49
CMD_LOAD_TEXTURE_COMPLETED = 51
CMD_GET_DYNAMICS_INFO_COMPLETED = 77
CMD_CREATE_COLLISION_SHAPE_COMPLETED = 80
CMD_CREATE_VISUAL_SHAPE_COMPLETED = 82
CMD_CREATE_MULTI_BODY_COMPLETED = 84
CMD_CUSTOM_COMMAND_COMPLETED = 89
CMD_SAVE_STATE_COMPLETED = 93
CMD_RESTORE_STATE_COMPLETED = 95
CMD_PERFORM_COLLISION_DETECTION_COMPLETED = 112

# enum eURDF_Flags
URDF_IGNORE_VISUAL_SHAPES = 1 << 20

# Collision group and mask that Bullet gives to links that can move, and to fixed bases.
FILTER_DYNAMIC = (1, -1)
FILTER_STATIC = (2, -1 ^ 2)

# enum for b3JointControlCommandInit2
CONTROL_MODE_POSITION_VELOCITY_PD = 2

# enum JointFeedbackMode
JOINT_FEEDBACK_IN_JOINT_FRAME = 2

# enum EnumRendererAuxFlags
ER_NO_SEGMENTATION_MASK = 4


class JointInfo(ctypes.Structure):
    """``struct b3JointInfo``."""

    _fields_ = (
        ("link_name", c_char * 1024),
        ("joint_name", c_char * 1024),
        ("joint_type", c_int),
        ("q_index", c_int),
        ("u_index", c_int),
        ("joint_index", c_int),
        ("flags", c_int),
        ("damping", c_double),
        ("friction", c_double),
        ("lower_limit", c_double),
        ("upper_limit", c_double),
        ("max_force", c_double),
        ("max_velocity", c_double),
        ("parent_frame", c_double * 7),
        ("child_frame", c_double * 7),
        ("axis", c_double * 3),
        ("parent_index", c_int),
        ("q_size", c_int),
        ("u_size", c_int),
    )


class DynamicsInfo(ctypes.Structure):
    """``struct b3DynamicsInfo``."""

    _fields_ = (
        ("mass", c_double),
        ("local_inertia_diagonal", c_double * 3),
        ("local_inertial_frame", c_double * 7),
        ("lateral_friction", c_double),
        ("rolling_friction", c_double),
        ("spinning_friction", c_double),
        ("restitution", c_double),
        ("contact_stiffness", c_double),
        ("contact_damping", c_double),
        ("activation_state", c_int),
        ("body_type", c_int),
        ("angular_damping", c_double),
        ("linear_damping", c_double),
        ("ccd_swept_sphere_radius", c_double),
        ("contact_processing_threshold", c_double),
        ("friction_anchor", c_int),
        ("collision_margin", c_double),
        ("dynamic_type", c_int),
    )


class ContactPoint(ctypes.Structure):
    """``struct b3ContactPointData``."""

    _fields_ = (
        ("flags", c_int),
        ("body_a", c_int),
        ("body_b", c_int),
        ("link_a", c_int),
        ("link_b", c_int),
        ("position_on_a", c_double * 3),
        ("position_on_b", c_double * 3),
        ("normal_on_b", c_double * 3),
        ("distance", c_double),
        ("normal_force", c_double),
        ("friction_force_1", c_double),
        ("friction_force_2", c_double),
        ("friction_direction_1", c_double * 3),
        ("friction_direction_2", c_double * 3),
    )


class ContactInformation(ctypes.Structure):
    """``struct b3ContactInformation``."""

    _fields_ = (("count", c_int), ("points", POINTER(ContactPoint)))


class CameraImage(ctypes.Structure):
    """``struct b3CameraImageData``."""

    _fields_ = (
        ("width", c_int),
        ("height", c_int),
        ("rgba", POINTER(c_ubyte)),
        ("depth", POINTER(c_float)),
        ("segmentation", POINTER(c_int)),
    )


class Doubles(c_void_p):
    """``const double *``: a ctypes array of numbers, or its address."""


class Floats(c_void_p):
    """``float *``: a ctypes array of numbers, or its address."""


# Functions that `_work` declares release the GIL during a call, and those that `_cheap`
# declares keep it; see library.py.
_work = partial(bind, WORK)
_cheap = partial(bind, CHEAP)
_client = _command = _status = c_void_p
_doubles, _floats = Doubles, Floats
_address = POINTER(c_void_p)  # output: the address of an array of doubles
_vector = (c_double,) * 3
_quaternion = (c_double,) * 4

# Connection, and the submission of commands
connect_direct = _work("b3ConnectPhysicsDirect", _client)
disconnect = _work("b3DisconnectSharedMemory", None, _client)
submit = _work("b3SubmitClientCommandAndWaitStatus", _status, _client, _command)
status_type = _cheap("b3GetStatusType", c_int, _status)

# World
physics_init = _cheap("b3InitPhysicsParamCommand", _command, _client)
physics_set_gravity = _cheap("b3PhysicsParamSetGravity", c_int, _command, *_vector)
physics_set_timestep = _cheap("b3PhysicsParamSetTimeStep", c_int, _command, c_double)
physics_set_solver_iterations = _cheap(
    "b3PhysicsParamSetNumSolverIterations", c_int, _command, c_int
)
physics_set_residual_threshold = _cheap(
    "b3PhysicsParamSetSolverResidualThreshold", c_int, _command, c_double
)
step_init = _cheap("b3InitStepSimulationCommand", _command, _client)
detect_init = _cheap("b3InitPerformCollisionDetectionCommand", _command, _client)

# Bodies
urdf_init = _cheap("b3LoadUrdfCommandInit", _command, _client, c_char_p)
urdf_set_position = _cheap(
    "b3LoadUrdfCommandSetStartPosition", c_int, _command, *_vector
)
urdf_set_orientation = _cheap(
    "b3LoadUrdfCommandSetStartOrientation", c_int, _command, *_quaternion
)
urdf_set_fixed_base = _cheap("b3LoadUrdfCommandSetUseFixedBase", c_int, _command, c_int)
urdf_set_flags = _cheap("b3LoadUrdfCommandSetFlags", c_int, _command, c_int)
status_body = _cheap("b3GetStatusBodyIndex", c_int, _status)
shape_init = _cheap("b3CreateCollisionShapeCommandInit", _command, _client)
shape_add_box = _cheap("b3CreateCollisionShapeAddBox", c_int, _command, _doubles)
shape_add_sphere = _cheap("b3CreateCollisionShapeAddSphere", c_int, _command, c_double)
shape_add_cylinder = _cheap(
    "b3CreateCollisionShapeAddCylinder", c_int, _command, c_double, c_double
)
status_shape = _cheap("b3GetStatusCollisionShapeUniqueId", c_int, _status)
body_init = _cheap("b3CreateMultiBodyCommandInit", _command, _client)
body_set_base = _cheap(
    "b3CreateMultiBodyBase",
    c_int,
    _command,
    c_double,  # mass
    c_int,  # collision shape
    c_int,  # visual shape
    _doubles,  # position
    _doubles,  # orientation
    _doubles,  # inertial frame position
    _doubles,  # inertial frame orientation
)
dynamics_init = _cheap("b3InitChangeDynamicsInfo", _command, _client)
_set_dynamics = (c_int, _command, c_int, c_int, c_double)  # body, link, value
dynamics_set_mass = _cheap("b3ChangeDynamicsInfoSetMass", *_set_dynamics)
dynamics_set_restitution = _cheap("b3ChangeDynamicsInfoSetRestitution", *_set_dynamics)
dynamics_set_joint_damping = _cheap(
    "b3ChangeDynamicsInfoSetJointDamping", *_set_dynamics
)
dynamics_set_lateral_friction = _cheap(
    "b3ChangeDynamicsInfoSetLateralFriction", *_set_dynamics
)
dynamics_set_rolling_friction = _cheap(
    "b3ChangeDynamicsInfoSetRollingFriction", *_set_dynamics
)
dynamics_set_spinning_friction = _cheap(
    "b3ChangeDynamicsInfoSetSpinningFriction", *_set_dynamics
)
dynamics_info_init = _cheap(
    "b3GetDynamicsInfoCommandInit", _command, _client, c_int, c_int
)
dynamics_info = _cheap("b3GetDynamicsInfo", c_int, _status, POINTER(DynamicsInfo))
joint_count = _cheap("b3GetNumJoints", c_int, _client, c_int)
joint_info = _cheap("b3GetJointInfo", c_int, _client, c_int, c_int, POINTER(JointInfo))

# Collision filter
filter_init = _cheap("b3CollisionFilterCommandInit", _command, _client)
filter_set_group_mask = _cheap(
    "b3SetCollisionFilterGroupMask",
    None,
    _command,
    c_int,  # body
    c_int,  # link
    c_int,  # group
    c_int,  # mask
)

# Poses
pose_init = _cheap("b3CreatePoseCommandInit", _command, _client, c_int)
pose_set_position = _cheap(
    "b3CreatePoseCommandSetBasePosition", c_int, _command, *_vector
)
pose_set_orientation = _cheap(
    "b3CreatePoseCommandSetBaseOrientation", c_int, _command, *_quaternion
)
pose_set_linear_velocity = _cheap(
    "b3CreatePoseCommandSetBaseLinearVelocity", c_int, _command, _doubles
)
pose_set_angular_velocity = _cheap(
    "b3CreatePoseCommandSetBaseAngularVelocity", c_int, _command, _doubles
)
pose_set_joint_position = _cheap(
    "b3CreatePoseCommandSetJointPosition", c_int, _client, _command, c_int, c_double
)
pose_set_joint_velocity = _cheap(
    "b3CreatePoseCommandSetJointVelocity", c_int, _client, _command, c_int, c_double
)

# Snapshots
save_init = _cheap("b3SaveStateCommandInit", _command, _client)
status_snapshot = _cheap("b3GetStatusGetStateId", c_int, _status)
load_init = _cheap("b3LoadStateCommandInit", _command, _client)
load_set_snapshot = _cheap("b3LoadStateSetStateId", c_int, _command, c_int)

# Motors
motor_init = _cheap("b3JointControlCommandInit2", _command, _client, c_int, c_int)
_set_motor = (c_int, _command, c_int, c_double)  # index in q or u, value
motor_set_position = _cheap("b3JointControlSetDesiredPosition", *_set_motor)
motor_set_velocity = _cheap("b3JointControlSetDesiredVelocity", *_set_motor)
motor_set_torque = _cheap("b3JointControlSetDesiredForceTorque", *_set_motor)
motor_set_kp = _cheap("b3JointControlSetKp", *_set_motor)
motor_set_kd = _cheap("b3JointControlSetKd", *_set_motor)
motor_set_force = _cheap("b3JointControlSetMaximumForce", *_set_motor)

# Inverse kinematics
ik_init = _cheap("b3CalculateInverseKinematicsCommandInit", _command, _client, c_int)
ik_set_target = _cheap(
    "b3CalculateInverseKinematicsAddTargetPositionWithOrientation",
    None,
    _command,
    c_int,
    _doubles,
    _doubles,
)
ik_set_iterations = _cheap(
    "b3CalculateInverseKinematicsSetMaxNumIterations", None, _command, c_int
)
ik_set_damping = _cheap(
    "b3CalculateInverseKinematicsSetJointDamping", None, _command, c_int, _doubles
)
ik_result = _cheap(
    "b3GetStatusInverseKinematicsJointPositions",
    c_int,
    _status,
    POINTER(c_int),
    POINTER(c_int),
    POINTER(c_double),  # output: positions of the joints
)

# State
state_init = _cheap("b3RequestActualStateCommandInit", _command, _client, c_int)
state_want_link_velocity = _cheap(
    "b3RequestActualStateCommandComputeLinkVelocity", c_int, _command, c_int
)
state_result = _cheap(
    "b3GetStatusActualState2",
    c_int,
    _status,
    POINTER(c_int),  # body
    POINTER(c_int),  # number of links
    POINTER(c_int),  # number of q
    POINTER(c_int),  # number of u
    _address,  # root inertial frame
    _address,  # q: base pose (7), then one per degree of freedom
    _address,  # u: base velocity (6), then one per degree of freedom
    _address,  # joint reaction forces (6 per joint)
    _address,  # link inertial frames (7 per link)
    _address,  # joint motor forces
    _address,  # link poses (7 per link), centre of mass, world frame
    _address,  # link velocities (6 per link), world frame
)
contact_init = _cheap("b3InitRequestContactPointInformation", _command, _client)
contact_result = _cheap(
    "b3GetContactPointInformation", None, _client, POINTER(ContactInformation)
)

# Sensors
sensor_init = _cheap("b3CreateSensorCommandInit", _command, _client, c_int)
sensor_enable_wrench = _cheap(
    "b3CreateSensorEnable6DofJointForceTorqueSensor", c_int, _command, c_int, c_int
)
physics_set_joint_feedback = _cheap(
    "b3PhysicsParameterSetJointFeedbackMode", c_int, _command, c_int
)

# Visual shapes and cameras
visual_init = _cheap("b3CreateVisualShapeCommandInit", _command, _client)
visual_add_box = _cheap("b3CreateVisualShapeAddBox", c_int, _command, _doubles)
visual_add_sphere = _cheap("b3CreateVisualShapeAddSphere", c_int, _command, c_double)
visual_add_cylinder = _cheap(
    "b3CreateVisualShapeAddCylinder", c_int, _command, c_double, c_double
)
visual_add_mesh = _cheap(
    "b3CreateVisualShapeAddMesh2",
    c_int,
    _client,
    _command,
    _doubles,  # scale
    _doubles,  # vertices
    c_int,
    POINTER(c_int),  # indices
    c_int,
    _doubles,  # normals
    c_int,
    _doubles,  # texture coordinates
    c_int,
)
visual_set_color = _cheap(
    "b3CreateVisualShapeSetRGBAColor", None, _command, c_int, _doubles
)
visual_set_specular = _cheap(
    "b3CreateVisualShapeSetSpecularColor", None, _command, c_int, _doubles
)
status_visual = _cheap("b3GetStatusVisualShapeUniqueId", c_int, _status)
texture_init = _cheap("b3InitLoadTexture", _command, _client, c_char_p)
status_texture = _cheap("b3GetStatusTextureUniqueId", c_int, _status)
visual_update_init = _cheap(
    "b3InitUpdateVisualShape2", _command, _client, c_int, c_int, c_int
)
visual_update_texture = _cheap("b3UpdateVisualShapeTexture", None, _command, c_int)
view_matrix = _cheap(
    "b3ComputeViewMatrixFromYawPitchRoll",
    None,
    _floats,  # target
    c_float,  # distance
    c_float,  # yaw
    c_float,  # pitch
    c_float,  # roll
    c_int,  # up axis
    _floats,
)
view_matrix_from_positions = _cheap(
    "b3ComputeViewMatrixFromPositions",
    None,
    _floats,  # eye
    _floats,  # target
    _floats,  # up
    _floats,
)
projection_matrix = _cheap(
    "b3ComputeProjectionMatrixFOV",
    None,
    c_float,  # field of view
    c_float,  # width / height
    c_float,  # near
    c_float,  # far
    _floats,
)
camera_init = _cheap("b3InitRequestCameraImage", _command, _client)
camera_set_matrices = _cheap(
    "b3RequestCameraImageSetCameraMatrices", None, _command, _floats, _floats
)
camera_set_size = _cheap(
    "b3RequestCameraImageSetPixelResolution", None, _command, c_int, c_int
)
camera_set_shadow = _cheap("b3RequestCameraImageSetShadow", None, _command, c_int)
camera_set_flags = _cheap("b3RequestCameraImageSetFlags", None, _command, c_int)
camera_result = _cheap("b3GetCameraImageData", None, _client, POINTER(CameraImage))
plugin_init = _cheap("b3CreateCustomCommand", _command, _client)
plugin_set_path = _cheap("b3CustomCommandLoadPlugin", None, _command, c_char_p)
plugin_set_suffix = _cheap(
    "b3CustomCommandLoadPluginSetPostFix", None, _command, c_char_p
)
status_plugin = _cheap("b3GetStatusPluginUniqueId", c_int, _status)

# The window of pybullet's GUI
connect_window = _work(
    "b3CreateInProcessPhysicsServerAndConnectMainThread"
    if sys.platform == "darwin"
    else "b3CreateInProcessPhysicsServerAndConnect",
    _client,
    c_int,
    POINTER(c_char_p),
)
window_init = _cheap("b3InitConfigureOpenGLVisualizer", _command, _client)
window_set_flag = _cheap(
    "b3ConfigureOpenGLVisualizerSetVisualizationFlags", None, _command, c_int, c_int
)
window_set_camera = _cheap(
    "b3ConfigureOpenGLVisualizerSetViewMatrix",
    None,
    _command,
    c_float,  # distance
    c_float,  # pitch
    c_float,  # yaw
    _floats,  # target
)
