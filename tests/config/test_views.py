"""Which pictures a policy may see: any that fit into memory, and of a scene those that it can draw."""

import pytest

from imfvla.config.views import ViewOptions, require_drawable
from imfvla.errors import UserError
from imfvla.tasks.bimanual_robot import LARGEST_PICTURE, bimanual_robot


@pytest.mark.parametrize("size", [(8, 8), (1080, 1920), (4096, 4096)])
def test_pictures_of_any_robot_may_be_larger_than_our_scene_draws(size):
    assert ViewOptions(("front",), size).image_size == size


@pytest.mark.parametrize("size", [(7, 8), (-1, 96), (100_000, 100_000), (0, 0)])
def test_what_is_no_picture_or_fills_the_memory_is_refused(size):
    with pytest.raises(
        UserError, match=r"observation\.image_size must be \[height, width\] of at least 8 pixels"
    ):
        ViewOptions(("front",), size)


def test_our_scene_draws_no_more_than_its_buffer_holds():
    assert bimanual_robot(["front"], LARGEST_PICTURE).cameras[0].height == LARGEST_PICTURE[0]
    with pytest.raises(UserError, match=r"observation\.image_size must be at most \[960, 1280\], the buffer"):
        bimanual_robot(["front"], (1080, 1920))
    with pytest.raises(UserError, match="image_size"):
        require_drawable((10, 20), (20, 10))
