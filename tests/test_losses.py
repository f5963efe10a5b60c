"""Losses: closed forms and masks."""

import numpy as np
import pytest
import torch
from media import random_values

from ddrecon.losses import HUBER, LOSSES, Target
from ddrecon.pictures import Noise, decode, encode


def image_loss(loss, image, target, mask=None, noise=None):
    return Target.of(target, mask, loss, noise).loss_of(image)


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_is_least_at_the_target_and_grows_away_from_it(loss):
    image = torch.rand(3, 4, 5, dtype=torch.float64)
    target = torch.rand(3, 4, 5, dtype=torch.float64)
    assert image_loss(loss, target, target) == 0
    values = [
        float(image_loss(loss, target + part * (image - target), target))
        for part in (0.1, 0.5, 1.0)
    ]
    assert 0 < values[0] < values[1] < values[2]


@pytest.mark.parametrize("loss", ["l2", "l1", "huber", "relative_l2"])
def test_a_loss_of_radiance_grows_with_the_square_of_all_brightness(loss):
    image, target = torch.rand(2, 3, 4, 5, dtype=torch.float64).unbind()
    value = float(image_loss(loss, image, target))
    assert float(image_loss(loss, 7 * image, 7 * target)) == pytest.approx(49 * value, rel=1e-12)


def test_small_errors_are_those_of_displayed_values():
    target = torch.linspace(0.0005, 0.99, 60, dtype=torch.float64).view(3, 4, 5)
    error = 1e-6 * torch.linspace(-1, 1, 60, dtype=torch.float64).view(3, 4, 5)
    shown = encode((target + error).numpy()) - encode(target.numpy())
    found = float(image_loss("display", target + error, target))
    assert found == pytest.approx(np.square(shown).mean(), rel=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_derivative_at_black_is_finite_and_not_zero(loss):
    target = torch.rand(3, 4, 5)
    target[:, :2] = 0
    image = torch.zeros(3, 4, 5, requires_grad=True)
    image_loss(loss, image, target).backward()
    assert torch.isfinite(image.grad).all() and (image.grad[:, 2:] < 0).all()


def test_what_is_brighter_than_a_white_pixel_of_a_display_does_not_err():
    target = torch.tensor([1.0, 0.5]).expand(3, 1, 2)
    brighter = torch.tensor([3.0, 0.5]).expand(3, 1, 2)
    assert image_loss("display", brighter, target) == 0
    assert image_loss("display", target - 0.1, target) > 0


def test_noise_counts_alike_in_dark_and_bright_pixels():
    noise = Noise(0.01, 0.002)
    for level in (0.0, 0.01, 1.0):
        target = torch.full((3, 8, 8), level, dtype=torch.float64)
        error = (0.01**2 + 0.002 * level) ** 0.5
        assert float(image_loss("photon", target + error, target, None, noise)) == pytest.approx(1)


def test_psnr_has_white_for_its_peak():
    """Of values, and of those that are displayed."""
    one = torch.ones(3, 8, 8)
    assert Target.of(one, None).psnr_of(one + 0.01) == pytest.approx(40, abs=1e-3)
    target = torch.full((3, 8, 8), 0.2)
    shown = float(encode(np.array(0.2))) + 0.01
    brighter = torch.full((3, 8, 8), float(decode(np.array(shown))))
    found = float(Target.of(target, None, "display").psnr_of(brighter))
    assert found == pytest.approx(40, abs=1e-2)


def test_huber_is_the_square_of_small_errors_and_grows_linearly_with_large_ones():
    target = torch.ones(3, 4, 5, dtype=torch.float64)
    small, large, larger = (
        float(image_loss("huber", target + error, target)) for error in (0.01, 10.0, 20.0)
    )
    assert small == pytest.approx(1e-4, rel=1e-9)
    assert larger - large == pytest.approx(2 * HUBER * 10, rel=1e-9)
    # The line touches the parabola where it begins.
    assert large == pytest.approx(HUBER**2 + 2 * HUBER * (10.0 - HUBER), rel=1e-9)


def test_a_relative_error_counts_alike_in_dark_and_bright_pixels():
    target = torch.tensor([1.0, 100.0], dtype=torch.float64).expand(3, 1, 2)
    dark, bright = (
        1.1 * target - 0.1 * target * torch.tensor(keep) for keep in ([0.0, 1.0], [1.0, 0.0])
    )
    losses = [float(image_loss("relative_l2", image, target)) for image in (dark, bright)]
    plain = [float(image_loss("l2", image, target)) for image in (dark, bright)]
    assert losses[1] / losses[0] < 0.01 * plain[1] / plain[0]


@pytest.mark.parametrize("loss", LOSSES)
def test_masked_pixels_do_not_count(loss):
    image, target, mask = torch.rand(3, 4, 5), torch.rand(3, 4, 5), (torch.rand(4, 5) > 0.5).float()
    spoiled, noise = torch.where(mask > 0, target, target + 100), Noise(0.01, 0.0)
    one, other = (image_loss(loss, image, each, mask, noise) for each in (spoiled, target))
    assert one == other


@pytest.mark.parametrize("loss", ["l2", "relative_l2", "photon", "display"])
def test_quality_within_a_mask_is_that_of_what_it_leaves(loss):
    """A mask that leaves a rectangle crops, whatever a lamp beside that does."""
    image, target, mask = torch.rand(3, 14, 18), torch.rand(3, 14, 18), torch.zeros(14, 18)
    left = slice(None), slice(2, 14), slice(5, 16)
    mask[left[1:]], noise = 1, Noise(0.01, 0.0)
    target = torch.where(mask > 0, target, 1000)
    masked, cropped = (
        Target.of(target, mask, loss, noise),
        Target.of(target[left], None, loss, noise),
    )
    assert float(masked.psnr_of(image)) == pytest.approx(float(cropped.psnr_of(image[left])))
    expected = pytest.approx(float(cropped.ssim_of(image[left])), abs=1e-5)
    assert float(masked.ssim_of(image)) == expected


def test_what_counts_is_averaged():
    image, target, mask = torch.rand(3, 4, 5), torch.rand(3, 4, 5), (torch.rand(4, 5) > 0.5).float()
    kept = mask.bool()
    expected = float(((image - target)[:, kept] ** 2).mean())
    assert float(image_loss("l2", image, target, mask)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_are_the_second_derivative_of_the_loss_or_of_a_parabola_above_it(loss):
    target = Target.of(0.8 * random_values(3, 4, 5), random_values(4, 5, seed=1).round(), loss)
    image = target.image + 0.4 * (random_values(3, 4, 5, seed=3) - 0.5)
    weights = target.weights_at(image)
    image = image.requires_grad_()
    (slope,) = torch.autograd.grad(target.loss_of(image), image)
    torch.testing.assert_close(slope, weights * (image.detach() - target.image))
    for part in (0.0, 0.5, 1.5, -2.0):
        other = target.image + part * (image.detach() - target.image)
        parabola = (weights * ((other - target.image) ** 2 - (image - target.image) ** 2)).sum() / 2
        assert target.loss_of(other) <= target.loss_of(image) + parabola + 1e-12
