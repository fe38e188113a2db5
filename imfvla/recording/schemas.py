"""JSON schemas of the recorded messages: Foxglove's well-known ones, and five of our own.

The Foxglove schemas have the field names of https://docs.foxglove.dev/docs/sdk/schemas, so that a
recording opens directly in Foxglove. Our own are flat enough that numbers have plot paths, as in
`/robot/state.left.joint_1`.
"""

from typing import Any

from imfvla.episode import ACTION_NAMES

Schema = dict[str, Any]


def _object(title: str, /, **properties: Schema) -> Schema:
    return {"title": title, "type": "object", "properties": properties}


def _array(items: Schema) -> Schema:
    return {"type": "array", "items": items}


NUMBER: Schema = {"type": "number"}
INTEGER: Schema = {"type": "integer"}
TEXT: Schema = {"type": "string"}
BOOLEAN: Schema = {"type": "boolean"}
BASE64: Schema = {"type": "string", "contentEncoding": "base64"}
NANOSECONDS: Schema = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
TIME = _object("time", sec={"type": "integer", "minimum": 0}, nsec=NANOSECONDS)
DURATION = _object("duration", sec=INTEGER, nsec=NANOSECONDS)

VECTOR3 = _object("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = _object("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
POSE = _object("foxglove.Pose", position=VECTOR3, orientation=QUATERNION)
COLOR = _object("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
KEY_VALUE = _object("foxglove.KeyValuePair", key=TEXT, value=TEXT)
CUBE = _object("foxglove.CubePrimitive", pose=POSE, size=VECTOR3, color=COLOR)
SPHERE = _object("foxglove.SpherePrimitive", pose=POSE, size=VECTOR3, color=COLOR)
CYLINDER = _object(
    "foxglove.CylinderPrimitive", pose=POSE, size=VECTOR3, bottom_scale=NUMBER, top_scale=NUMBER, color=COLOR
)
SCENE_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=TIME,
    frame_id=TEXT,
    id=TEXT,
    lifetime=DURATION,
    frame_locked=BOOLEAN,
    metadata=_array(KEY_VALUE),
    arrows=_array({"type": "object"}),
    cubes=_array(CUBE),
    spheres=_array(SPHERE),
    cylinders=_array(CYLINDER),
    lines=_array({"type": "object"}),
    triangles=_array({"type": "object"}),
    texts=_array({"type": "object"}),
    models=_array({"type": "object"}),
)
SCENE_ENTITY_DELETION = _object("foxglove.SceneEntityDeletion", timestamp=TIME, type=INTEGER, id=TEXT)
FRAME_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=TIME,
    parent_frame_id=TEXT,
    child_frame_id=TEXT,
    translation=VECTOR3,
    rotation=QUATERNION,
)


def _by_arm(title: str) -> Schema:
    """One number for each of ACTION_NAMES, as {"left": {"joint_1": ..., "gripper": ...}, "right": {...}}."""
    arms: dict[str, dict[str, Schema]] = {}
    for name in ACTION_NAMES:
        arm, joint = name.split("/")
        arms.setdefault(arm, {})[joint] = NUMBER
    return _object(title, **{arm: _object(f"{title}.{arm}", **joints) for arm, joints in arms.items()})


COMPRESSED_IMAGE = _object(
    "foxglove.CompressedImage", timestamp=TIME, frame_id=TEXT, data=BASE64, format=TEXT
)
FRAME_TRANSFORMS = _object("foxglove.FrameTransforms", transforms=_array(FRAME_TRANSFORM))
SCENE_UPDATE = _object(
    "foxglove.SceneUpdate", deletions=_array(SCENE_ENTITY_DELETION), entities=_array(SCENE_ENTITY)
)
LOG = _object("foxglove.Log", timestamp=TIME, level=INTEGER, message=TEXT, name=TEXT, file=TEXT, line=INTEGER)
ROBOT_STATE = _by_arm("imfvla.RobotState")
ROBOT_ACTION = _object(
    "imfvla.RobotAction", clean=_by_arm("imfvla.CleanAction"), executed=_by_arm("imfvla.ExecutedAction")
)
ACTION_CHUNK = _object("imfvla.ActionChunk", step=INTEGER, names=_array(TEXT), actions=_array(_array(NUMBER)))
REWARD = _object("imfvla.Reward", reward=NUMBER, stage=INTEGER)
INFERENCE = _object("imfvla.Inference", ms=NUMBER)
