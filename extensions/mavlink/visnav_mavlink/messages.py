"""Table of all messages of the dialect: what the vehicle does with each.

The dispatcher of the endpoint, the words of a refusal and the page of the docs come from here.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

Treatment = Literal["obeyed", "judged", "answered", "refused", "not for a vehicle"]


class Row(NamedTuple):
    """Treatment of some kinds of message.

    Attributes:
        kinds: Their names, with spaces between.
        words: What is done, or why it is refused.
    """

    treatment: Treatment
    kinds: str
    words: str


ROWS = (
    Row("obeyed", "COMMAND_LONG COMMAND_INT", "acknowledged each, also one that is not supported"),
    Row("obeyed", "SET_MODE", "modes of PX4"),
    Row(
        "obeyed",
        "SET_POSITION_TARGET_LOCAL_NED SET_POSITION_TARGET_GLOBAL_INT SET_ATTITUDE_TARGET",
        "in offboard mode, each bit of the mask by itself",
    ),
    Row(
        "obeyed",
        "MISSION_COUNT MISSION_ITEM MISSION_ITEM_INT MISSION_ACK MISSION_CLEAR_ALL "
        "MISSION_SET_CURRENT",
        "of type MISSION; fences and rally points are refused, and clearing them clears nothing",
    ),
    Row("obeyed", "PARAM_SET", "of the parameters below"),
    Row(
        "obeyed",
        "MANUAL_CONTROL",
        "in PX4's modes POSCTL and ALTCTL, as velocities along and across the heading",
    ),
    Row("obeyed", "REQUEST_DATA_STREAM", "sets the rates of a stream's messages for this link"),
    Row("obeyed", "HEARTBEAT", "the link lives, as by any other message"),
    Row(
        "judged",
        "ODOMETRY VISION_POSITION_ESTIMATE VICON_POSITION_ESTIMATE ATT_POS_MOCAP "
        "GLOBAL_VISION_POSITION_ESTIMATE",
        "as poses of an estimator, if `vision` is true; those of another vehicle are not",
    ),
    Row(
        "judged",
        "VISION_SPEED_ESTIMATE",
        "as the velocity of its sender's pose of the same stamp; alone it has no effect",
    ),
    Row(
        "judged",
        "VISION_POSITION_DELTA",
        "of ArduPilot's dialect; added up to poses, unless its sender sends poses, too",
    ),
    Row(
        "answered",
        "MISSION_REQUEST_LIST MISSION_REQUEST MISSION_REQUEST_INT PARAM_REQUEST_LIST "
        "PARAM_REQUEST_READ TIMESYNC PING",
        "by what they ask for",
    ),
    Row(
        "refused",
        "MANUAL_SETPOINT RC_CHANNELS_OVERRIDE",
        "sticks fly by MANUAL_CONTROL",
    ),
    Row(
        "refused",
        "OPTICAL_FLOW OPTICAL_FLOW_RAD DISTANCE_SENSOR OBSTACLE_DISTANCE LANDING_TARGET GPS_INPUT "
        "GPS_RTCM_DATA GPS_INJECT_DATA GLOBAL_POSITION_SENSOR WHEEL_DISTANCE AIRSPEED",
        "no filter here fuses what other sensors measure",
    ),
    Row("refused", "SET_GPS_GLOBAL_ORIGIN", "the origin is that of the run's file"),
    Row("refused", "SET_HOME_POSITION", "home is where the vehicle stood at first"),
    Row("refused", "SET_ACTUATOR_CONTROL_TARGET", "motors are not driven by MAVLink"),
    Row("refused", "FOLLOW_TARGET", "nobody is followed"),
    Row(
        "refused",
        "TRAJECTORY_REPRESENTATION_WAYPOINTS TRAJECTORY_REPRESENTATION_BEZIER",
        "paths are not taken, set-points are",
    ),
    Row(
        "refused",
        "MISSION_REQUEST_PARTIAL_LIST MISSION_WRITE_PARTIAL_LIST",
        "missions go up and down as a whole",
    ),
    Row(
        "refused",
        "PARAM_EXT_REQUEST_LIST PARAM_EXT_REQUEST_READ PARAM_EXT_SET",
        "there are no extended parameters, which cameras have",
    ),
    Row("refused", "PARAM_MAP_RC", "there is no radio control"),
    Row(
        "refused",
        "LOG_REQUEST_LIST LOG_REQUEST_DATA LOG_ERASE LOG_REQUEST_END LOGGING_ACK",
        "there are no logs on board: a run's files hold all",
    ),
    Row("refused", "FILE_TRANSFER_PROTOCOL", "there are no files on board"),
    Row("refused", "SERIAL_CONTROL TUNNEL V2_EXTENSION RESOURCE_REQUEST", "nothing is behind it"),
    Row("refused", "CAN_FRAME CANFD_FRAME CAN_FILTER_MODIFY", "there is no CAN bus"),
    Row("refused", "CHANGE_OPERATOR_CONTROL", "whoever reaches a link flies"),
    Row("refused", "AUTH_KEY SETUP_SIGNING", "the key is that of the run's file, signing_key"),
    Row("refused", "SAFETY_SET_ALLOWED_AREA", "there are no fences"),
    Row("refused", "TERRAIN_DATA TERRAIN_CHECK", "there is no map of the terrain"),
    Row(
        "refused",
        "GIMBAL_DEVICE_SET_ATTITUDE GIMBAL_MANAGER_SET_ATTITUDE GIMBAL_MANAGER_SET_PITCHYAW "
        "GIMBAL_MANAGER_SET_MANUAL_CONTROL",
        "there is no gimbal",
    ),
    Row("refused", "PLAY_TUNE WIFI_CONFIG_AP", "there is no such device"),
    Row("refused", "DATA_TRANSMISSION_HANDSHAKE ENCAPSULATED_DATA", "images are not taken"),
    Row("refused", "ADSB_VEHICLE AIS_VESSEL COLLISION", "traffic is not avoided"),
    Row(
        "refused",
        "OPEN_DRONE_ID_AUTHENTICATION OPEN_DRONE_ID_BASIC_ID OPEN_DRONE_ID_LOCATION "
        "OPEN_DRONE_ID_MESSAGE_PACK OPEN_DRONE_ID_OPERATOR_ID OPEN_DRONE_ID_SELF_ID "
        "OPEN_DRONE_ID_SYSTEM OPEN_DRONE_ID_SYSTEM_UPDATE",
        "there is no remote identification",
    ),
    Row(
        "refused",
        "HIL_SENSOR HIL_GPS HIL_STATE HIL_STATE_QUATERNION HIL_OPTICAL_FLOW HIL_RC_INPUTS_RAW "
        "HIL_CONTROLS HIL_ACTUATOR_CONTROLS",
        "a simulation's messages belong to a Px4 node",
    ),
    Row(
        "not for a vehicle",
        "ACTUATOR_CONTROL_TARGET ACTUATOR_OUTPUT_STATUS ALTITUDE ATTITUDE ATTITUDE_QUATERNION "
        "ATTITUDE_QUATERNION_COV ATTITUDE_TARGET AUTOPILOT_STATE_FOR_GIMBAL_DEVICE "
        "AUTOPILOT_VERSION BATTERY_STATUS BUTTON_CHANGE CONTROL_SYSTEM_STATE EFI_STATUS "
        "ESTIMATOR_STATUS EXTENDED_SYS_STATE FENCE_STATUS FLIGHT_INFORMATION GENERATOR_STATUS "
        "GLOBAL_POSITION_INT GLOBAL_POSITION_INT_COV GPS2_RAW GPS2_RTK GPS_GLOBAL_ORIGIN "
        "GPS_RAW_INT GPS_RTK GPS_STATUS HIGHRES_IMU HIGH_LATENCY HIGH_LATENCY2 HOME_POSITION "
        "HYGROMETER_SENSOR ISBD_LINK_STATUS LOCAL_POSITION_NED LOCAL_POSITION_NED_COV "
        "LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET MAG_CAL_REPORT NAV_CONTROLLER_OUTPUT "
        "ORBIT_EXECUTION_STATUS POSITION_TARGET_GLOBAL_INT POSITION_TARGET_LOCAL_NED POWER_STATUS "
        "RADIO_STATUS RAW_IMU RAW_PRESSURE RAW_RPM RC_CHANNELS RC_CHANNELS_RAW RC_CHANNELS_SCALED "
        "RELAY_STATUS SAFETY_ALLOWED_AREA SCALED_IMU SCALED_IMU2 SCALED_IMU3 SCALED_PRESSURE "
        "SCALED_PRESSURE2 SCALED_PRESSURE3 SERVO_OUTPUT_RAW SIM_STATE SMART_BATTERY_INFO "
        "SYSTEM_TIME SYS_STATUS TERRAIN_REPORT TERRAIN_REQUEST UTM_GLOBAL_POSITION VFR_HUD "
        "VIBRATION WINCH_STATUS WIND_COV",
        "another vehicle's telemetry",
    ),
    Row(
        "not for a vehicle",
        "CHANGE_OPERATOR_CONTROL_ACK COMMAND_ACK DATA_STREAM LOGGING_DATA LOGGING_DATA_ACKED "
        "LOG_DATA LOG_ENTRY MESSAGE_INTERVAL MISSION_CURRENT MISSION_ITEM_REACHED "
        "OPEN_DRONE_ID_ARM_STATUS PARAM_ERROR PARAM_EXT_ACK PARAM_EXT_VALUE PARAM_VALUE",
        "another vehicle's answers",
    ),
    Row(
        "not for a vehicle",
        "CAMERA_CAPTURE_STATUS CAMERA_FOV_STATUS CAMERA_IMAGE_CAPTURED CAMERA_INFORMATION "
        "CAMERA_SETTINGS CAMERA_THERMAL_RANGE CAMERA_TRACKING_GEO_STATUS "
        "CAMERA_TRACKING_IMAGE_STATUS CAMERA_TRIGGER GIMBAL_DEVICE_ATTITUDE_STATUS "
        "GIMBAL_DEVICE_INFORMATION GIMBAL_MANAGER_INFORMATION GIMBAL_MANAGER_STATUS "
        "MOUNT_ORIENTATION ONBOARD_COMPUTER_STATUS STORAGE_INFORMATION UAVCAN_NODE_INFO "
        "UAVCAN_NODE_STATUS VIDEO_STREAM_INFORMATION VIDEO_STREAM_STATUS",
        "states of cameras, gimbals and computers",
    ),
    Row(
        "not for a vehicle",
        "DEBUG DEBUG_FLOAT_ARRAY DEBUG_VECT MEMORY_VECT NAMED_VALUE_FLOAT NAMED_VALUE_INT "
        "STATUSTEXT",
        "words and numbers for people",
    ),
)

TREATMENTS = {kind: row for row in ROWS for kind in row.kinds.split()}
"""Row of each kind of message."""
OF_ARDUPILOT = {"UNKNOWN_11011": "VISION_POSITION_DELTA"}
"""Names of kinds that only ArduPilot's dialect has, by what the common one calls them."""


def table() -> str:
    """Return the table in Markdown."""
    lines = ["| | messages | |", "|---|---|---|"]
    for row in ROWS:
        kinds = ", ".join(f"`{kind}`" for kind in row.kinds.split())
        lines.append(f"| {row.treatment} | {kinds} | {row.words} |")
    return "\n".join(lines)
