"""AdamW with weight decay where it belongs: on matrices and kernels."""

from types import MappingProxyType

from torch import nn
from torch.optim import AdamW

from imfvla.training.options import OptimOptions
from imfvla.training.spans import WHOLE, Span, Spans

# Learned vectors that are looked up or added, not multiplied with: last part of their parameter names.
UNDECAYED_NAMES = (
    "query",
    "queries",
    "position",
    "positions",
    "identity",
    "embedding",
    "embeddings",
    "token",
    "tokens",
)
UNDECAYED_MODULES = (
    nn.Embedding,
    nn.EmbeddingBag,
    nn.LayerNorm,
    nn.RMSNorm,
    nn.GroupNorm,
    nn.modules.batchnorm._BatchNorm,
)


def make_optimiser(policy: nn.Module, options: OptimOptions, spans: Spans = MappingProxyType({})) -> AdamW:
    """AdamW over all trainable parameters; its rates are set by the loop before each step.

    Parameters of equal decay that learn in the same steps are a group, with a `span`.
    """
    decayed = decayed_parameters(policy)
    groups: dict[tuple[Span, bool], list[nn.Parameter]] = {}
    for name, parameter in policy.named_parameters():
        if parameter.requires_grad:
            groups.setdefault((spans.get(name, WHOLE), name in decayed), []).append(parameter)
    groups = [
        {"params": params, "weight_decay": options.weight_decay if decays else 0.0, "span": span}
        for (span, decays), params in sorted(groups.items(), key=lambda item: (item[0][0], not item[0][1]))
    ]
    return AdamW(groups, lr=options.lr, betas=options.betas, eps=options.eps, fused=True)


def decayed_parameters(policy: nn.Module) -> set[str]:
    """Names of the parameters that weight decay applies to.

    Not biases and gains (vectors), not what norms and embeddings own, not learned queries, positions and
    identities: shrinking those changes what is looked up rather than how strongly.
    """
    names = set()
    for prefix, module in policy.named_modules():
        if isinstance(module, UNDECAYED_MODULES):
            continue
        for name, parameter in module.named_parameters(recurse=False):
            is_lookup = any(name == known or name.endswith(f"_{known}") for known in UNDECAYED_NAMES)
            if parameter.ndim >= 2 and not is_lookup:
                names.add(f"{prefix}.{name}" if prefix else name)
    return names
