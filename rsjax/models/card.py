"""The README.md of a saved model: what it takes and returns, and what else is known of it."""

from rsjax.config import Config

LIMITS = """\
- It knows the robot, the camera, the objects and the kinds of motion that it was trained on. Other pictures give frames
  that look like the training data, whatever is in them; nothing warns of that.
- Errors add up from frame to frame. Where it is unsure it shows a blur, or an object follows a gripper that does not
  hold it: do not read success in a generated video as success on a robot without a check in the real world.
- Actions far from those of the training data lead to frames that mean nothing.

Do not drive a robot by generated video alone, and do not pass generated video off as a recording. In data sets that
others train on, say which clips are generated.
"""


def model_card(config: Config, name: str, sections: str = "", license: str = "") -> str:
    """Returns the text of a model card, with the metadata that hubs read at its head.

    Args:
        name: of the model, for its title and for the example.
        sections: further sections, with headings; empty: the limits that hold for all models.
        license: as hubs name it, such as ``apache-2.0``; empty: none is named.
    """
    head = ["library_name: rsjax", "pipeline_tag: robotics", "tags: [robotics, world-model, video-prediction, jax]"]
    if license:
        head.append(f"license: {license}")
    depth = ""
    if config.model.uses_depth:
        depth = "\nWith the depth of the first frame in metres (`depth=`), it generates depth as well."
    clips = config.clips
    size = clips.image_size
    about = f"""\
A world model of robot video of the family `{config.model.family}`, made with rsjax: from a first frame and the robot's
actions it generates the video that follows.

```python
import rsjax

model = rsjax.load("{name}")
video = model.generate(first_frame, actions)
print(video.rgb.shape)  # uint8 (T, {size}, {size}, 3)
```

`first_frame` is uint8 (1, {size}, {size}, 3), RGB. `actions` is (T, {clips.action_dim}) in the units of the recordings;
row t leads into frame t, and row 0 is not read. The clips of its training have {clips.frames} frames; T may be larger.\
{depth}
"""
    limits = sections or f"## Limits and misuse\n\n{LIMITS}"
    return "\n".join(["---", *head, "---", "", f"# {name}", "", about, limits])
