"""JSON schemas of the recorded messages: Foxglove's well-known ones, and those of our own that suit any robot.

The Foxglove schemas have the field names of https://docs.foxglove.dev/docs/sdk/schemas, so that a recording opens
directly in Foxglove. Those of a robot's state and action are in `channels.py`.
"""

from typing import Any

Schema = dict[str, Any]


def object_of(title: str, /, **properties: Schema) -> Schema:
    """An object with these properties, none of them required."""
    return {"title": title, "type": "object", "properties": properties}


def _array(items: Schema) -> Schema:
    return {"type": "array", "items": items}


NUMBER: Schema = {"type": "number"}
INTEGER: Schema = {"type": "integer"}
TEXT: Schema = {"type": "string"}
BOOLEAN: Schema = {"type": "boolean"}
BASE64: Schema = {"type": "string", "contentEncoding": "base64"}
NANOSECONDS: Schema = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
TIME = object_of("time", sec={"type": "integer", "minimum": 0}, nsec=NANOSECONDS)
DURATION = object_of("duration", sec=INTEGER, nsec=NANOSECONDS)

VECTOR3 = object_of("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = object_of("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
POSE = object_of("foxglove.Pose", position=VECTOR3, orientation=QUATERNION)
COLOR = object_of("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
KEY_VALUE = object_of("foxglove.KeyValuePair", key=TEXT, value=TEXT)
CUBE = object_of("foxglove.CubePrimitive", pose=POSE, size=VECTOR3, color=COLOR)
SPHERE = object_of("foxglove.SpherePrimitive", pose=POSE, size=VECTOR3, color=COLOR)
CYLINDER = object_of(
    "foxglove.CylinderPrimitive", pose=POSE, size=VECTOR3, bottom_scale=NUMBER, top_scale=NUMBER, color=COLOR
)
SCENE_ENTITY = object_of(
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
SCENE_ENTITY_DELETION = object_of("foxglove.SceneEntityDeletion", timestamp=TIME, type=INTEGER, id=TEXT)
FRAME_TRANSFORM = object_of(
    "foxglove.FrameTransform",
    timestamp=TIME,
    parent_frame_id=TEXT,
    child_frame_id=TEXT,
    translation=VECTOR3,
    rotation=QUATERNION,
)


COMPRESSED_IMAGE = object_of(
    "foxglove.CompressedImage", timestamp=TIME, frame_id=TEXT, data=BASE64, format=TEXT
)
FRAME_TRANSFORMS = object_of("foxglove.FrameTransforms", transforms=_array(FRAME_TRANSFORM))
SCENE_UPDATE = object_of(
    "foxglove.SceneUpdate", deletions=_array(SCENE_ENTITY_DELETION), entities=_array(SCENE_ENTITY)
)
LOG = object_of(
    "foxglove.Log", timestamp=TIME, level=INTEGER, message=TEXT, name=TEXT, file=TEXT, line=INTEGER
)
ACTION_CHUNK = object_of(
    "imfvla.ActionChunk", step=INTEGER, names=_array(TEXT), actions=_array(_array(NUMBER))
)
REWARD = object_of("imfvla.Reward", reward=NUMBER, stage=INTEGER)
IMITATE = object_of("imfvla.Imitate", imitate=BOOLEAN)
INFERENCE = object_of("imfvla.Inference", ms=NUMBER)
