"""ImageNet weights of torchvision's resnet18 in our ResNet18.

Convolutions are copied key by key; gains and shifts of batch norms go to the group norms that replace them. Batch
statistics and the classifier have no counterpart.
"""

from torch import Tensor, nn

from imfvla.nn.pretrained import read_weights, take_weights

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of red, green and blue in [0, 1]
STATISTICS = ("running_mean", "running_var", "num_batches_tracked")  # of a batch norm
CLASSIFIER = ("fc.weight", "fc.bias")
KEY = "encoder.vision.pretrained"


def load_torchvision(trunk: nn.Module, path: str) -> None:
    """Fills the trunk from a safetensors file of torchvision's state_dict. Raises UserError where it does not fit."""
    modules = torchvision_modules()
    norms = [
        theirs for theirs, ours in modules.items() if isinstance(trunk.get_submodule(ours), nn.GroupNorm)
    ]
    ignored = {f"{name}.{statistic}" for name in norms for statistic in STATISTICS} | {*CLASSIFIER}
    parameters: dict[str, Tensor] = {
        f"{theirs}.{name}": parameter
        for theirs, ours in modules.items()
        for name, parameter in trunk.get_submodule(ours).named_parameters()
    }
    take_weights(parameters, read_weights(path, KEY), ignored, f"{KEY}={path} is not torchvision's resnet18")


def torchvision_modules() -> dict[str, str]:
    """Our names of convolutions and norms by torchvision's."""
    modules = {"conv1": "stem.0", "bn1": "stem.1"}
    for stage in range(4):
        for block in range(2):
            theirs, ours = f"layer{stage + 1}.{block}", f"stages.{stage}.{block}"
            body = {"conv1": 0, "bn1": 1, "conv2": 3, "bn2": 4}
            modules |= {f"{theirs}.{name}": f"{ours}.body.{index}" for name, index in body.items()}
            if stage > 0 and block == 0:
                modules |= {f"{theirs}.downsample.{index}": f"{ours}.shortcut.{index}" for index in range(2)}
    return modules
