"""How large the parts of a network may be: what is larger is a typing error, and would be built for minutes."""

from imfvla.options import within

LAYERS = within(1, 256)
WIDTH = within(1, 16_384)  # of tokens and heads
