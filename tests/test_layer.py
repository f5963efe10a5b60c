"""The renderer as a layer: networks train through it, and so do torch's function transforms."""

import math
import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from media import make_scene, random_values, tensor
from scenes import cloud

import ddrecon
from ddrecon.engine import ENGINES
from ddrecon.errors import UsageError
from ddrecon.layer import VolumeRenderer, render
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import AmbientLight, BeamLight, DirectionalLight
from ddrecon.settings import DiffusionSettings, RenderSettings
from ddrecon.variables.kinds import EXTINCTION_AND_ALBEDO
from ddrecon.variables.values import value_of, variable_names, with_values

SHAPE = (5, 4, 6)
BALL = Path(__file__).parents[1] / "configs" / "ball.yaml"


LIGHTS = ["lights.0.irradiance", "lights.0.direction", "lights.1.radiance"]
NAMES = ["density", "sigma_a", "sigma_s", "g", *LIGHTS, "views.view.camera"]


FUSED = [pytest.param(name, "warp", marks=pytest.mark.slow) for name in ("density", "g")]


@pytest.mark.parametrize(("name", "engine"), [*((name, "torch") for name in NAMES), *FUSED])
def test_function_transforms_agree_with_backward(name, engine):
    ddrecon.use_engine(engine)
    scene = make_scene(random_values(*SHAPE), g=0.3, ambient=(0.2,))
    value = value_of(scene, name)
    change = random_values(*value.shape, seed=1) - 0.5

    def image(moved):
        return render(with_values(scene, {name: moved}))

    out, tangent = torch.func.jvp(image, (value,), (change,))
    weight = random_values(*out.shape, seed=2)
    leaf = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((image(leaf) * weight).sum(), leaf)
    one, other = (tangent * weight).sum(), (gradient * change).sum()
    assert abs(one - other) <= 1e-10 * max(abs(one), abs((tangent * weight).abs().sum()) * 1e-2)


def lit_scene():
    """A glowing volume with a light of each kind, over a ground; of diffusion nothing is said."""
    scene = cloud()
    scene.diffusion = DiffusionSettings()
    scene.volume.emission = tensor(0.1, 0.2, 0.3)
    beam = tensor(0.1, 2.0, 0.0), tensor(0.1, -1.0, 0.2), tensor(2.0), tensor(0.2)[0]
    scene.lights = [*scene.lights, AmbientLight(tensor(0.2)), BeamLight(*beam)]
    scene.ground = Ground(tensor(0.4), Plane(-1.0, 1))
    return scene


@pytest.mark.slow
@pytest.mark.usefixtures("few_directions")
def test_a_tensor_that_changed_unseen_is_as_a_new_one():
    """No picture depends on what was rendered before, however a scene's numbers have changed."""
    scene = lit_scene()
    before = render(scene)
    for name in variable_names(scene):
        if not name.startswith("views.") and name not in EXTINCTION_AND_ALBEDO:
            value = value_of(scene, name)
            np.copyto(value.numpy(), value.lerp(torch.ones_like(value), 0.3))
    after = render(scene)
    assert not torch.equal(after, before)
    assert torch.equal(after, render(replace(deepcopy(scene))))


def small_layer(dtype=torch.float64, **kind):
    density = random_values(*SHAPE, dtype=dtype)
    scene = make_scene(density, ambient=(0.2,), tolerance=1e-6, g=0.3, **kind)
    scene.starts["density"] = random_values(*SHAPE, dtype=dtype)
    return VolumeRenderer(scene)


def test_the_scene_moves_with_the_layer():
    layer = small_layer()
    before = layer()
    layer.scene.volume.density.requires_grad_()
    single = torch.nn.Sequential(layer).to(torch.float32)[0]
    image = single()
    assert image.dtype == torch.float32 and single.scene.volume.density.requires_grad
    torch.testing.assert_close(image.double(), before, rtol=1e-4, atol=1e-5)
    for name in (*NAMES[:4], *LIGHTS[1:]):
        assert value_of(single.scene, name).dtype == torch.float32
    assert single.scene.views[0].camera.pose.dtype == torch.float32
    assert single.scene.starts["density"].dtype == torch.float32
    assert value_of(small_layer().to("meta").scene, "lights.0.irradiance").device.type == "meta"
    told = r"not computed in torch\.float16; leave the layer in float3"
    with pytest.raises(UsageError, match=told):
        single.half()
    assert single().dtype == torch.float32


@pytest.mark.parametrize("given", [torch.bfloat16, torch.float32, torch.float64])
def test_precision_is_the_layers_whatever_it_is_given(given):
    """Also under autocast, and after a call in another precision."""
    layer = small_layer(torch.float32)
    layer(density=random_values(*SHAPE))
    density = random_values(*SHAPE).to(given).requires_grad_()
    expected = layer(density=density.detach().float())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        image = layer(density=density)
    assert image.dtype == torch.float32
    torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-6)
    image.sum().backward()
    assert density.grad is not None and density.grad.dtype == given


def test_a_batch_is_its_entries_one_by_one():
    """Of densities, cross sections and light directions; the derivative as well."""
    layer = small_layer()
    densities = random_values(3, *SHAPE, seed=1).requires_grad_()
    values = {"lights.0.direction": random_values(3, 3, seed=3) - 2.0}
    values["lights.1.radiance"] = random_values(3, seed=4)
    batch = {"density": densities, "sigma_s": random_values(3, 3, seed=2), "values": values}
    batch["g"] = torch.tensor([0.1, 0.3, 0.5], dtype=torch.float64)
    images = layer(**batch)
    weight = random_values(*images.shape, seed=5)
    (gradient,) = torch.autograd.grad((images * weight).sum(), densities)
    assert images.shape == (3, 1, 3, 4, 5)
    for i in range(3):
        density = densities[i].detach().requires_grad_()
        values = {name: value[i] for name, value in batch["values"].items()}
        values["lights.1.radiance"] = batch["values"]["lights.1.radiance"]
        one = small_layer()(density, sigma_s=batch["sigma_s"][i], g=batch["g"][i], values=values)
        torch.testing.assert_close(images[i], one, rtol=1e-5, atol=1e-7)
        (alone,) = torch.autograd.grad((one * weight[i]).sum(), density)
        torch.testing.assert_close(gradient[i], alone, rtol=1e-3, atol=1e-6)
    with pytest.raises(UsageError, match="batches differ in size"):
        layer(density=densities, g=torch.tensor([0.1, 0.2]))


BATCHES = {
    "density": [((2, *SHAPE), 2), ((1, *SHAPE), 1), (SHAPE, None)],
    "g": [((2,), 2), ((2, *SHAPE), 2), ((2, 1, *SHAPE), 2), (SHAPE, None), ((1, *SHAPE), None)],
    "sigma_s": [((3,), None), ((2, 3), 2), ((3, 3), 3), ((2, 3, *SHAPE), 2), ((3, *SHAPE), None)],
    "albedo": [((1,), None), ((2, 1), 2), ((1, 1, *SHAPE), 1), ((1, *SHAPE), None)],
    "lights.0.direction": [((3,), None), ((2, 3), 2), ((3, 3), 3)],
    "views.view.exposure": [((3,), None), ((2, 1), 2)],
}


@pytest.mark.parametrize(
    ("name", "shape", "count"), [(name, *case) for name, cases in BATCHES.items() for case in cases]
)
def test_one_axis_more_than_a_number_may_have_is_a_batch(name, shape, count):
    value = 0.3 + 0.1 * random_values(*shape)
    layer = VolumeRenderer(make_scene(random_values(*SHAPE), model="none"))
    images = layer(values={name: value})
    alone = layer(values={name: value if count is None else value[0]})
    assert images.shape == (alone.shape if count is None else (count, *alone.shape))
    torch.testing.assert_close(images if count is None else images[0], alone)


DOUBLE = {"dtype": torch.float64}
NAN = math.nan
WRONG: dict[str, list[Any]] = {
    "density": [
        *(torch.full(SHAPE, value, **DOUBLE) for value in (-1.0, NAN)),
        *(torch.ones(5, 4, **DOUBLE), torch.ones(SHAPE, device="meta", **DOUBLE), 0.5),
    ],
    "sigma_s": [tensor(3.0, -1.0, 2.0), tensor(math.inf), tensor(1.0, 1.0)],
    "g": [tensor(1.0)[0]],
    "lights.0.direction": [tensor(0.0, 0.0, 0.0), tensor(1.0, 1.0)],
    "lights.0.irradiance": [tensor(-1.0)],
    "depth": [tensor(1.0)],
    # A pose that training has lost would be seen as an empty picture.
    "views.view.camera": [tensor(1.0, 1.0, 1.0), tensor(*[NAN] * 6)],
    "views.view.exposure": [tensor(-1.0), tensor(0.0), tensor(NAN)],
    "views.view.offset": [tensor(1.0, math.inf, 0.0)],
    "views.view.principal_point": [tensor(0.5, NAN)],
    "views.view.distortion": [tensor(*[math.inf] * 6)],
    "views.view.focal": [tensor(focal)[0] for focal in (0.0, -1.0, NAN)],
}


def lens_layer():
    layer = small_layer()
    (view,), lens = layer.scene.views, {"lens": "opencv", "distortion": torch.zeros(6, **DOUBLE)}
    view.camera = replace(view.camera, **lens)
    return layer


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in WRONG.items() for value in values]
)
def test_what_no_scene_file_may_say_is_refused(name, value):
    """By the layer, by name, and where a scene's own tensor was replaced."""
    layer = lens_layer()
    place = re.escape(name.replace("focal", "camera: half_width, 1 / (2 focal)"))
    with pytest.raises(UsageError, match=place):
        layer(values={name: value})
    with pytest.raises(UsageError, match=place):
        render(with_values(layer.scene, {name: value}))
    if name in ("density", "sigma_s", "g"):
        setattr(layer.scene.volume, name, value)
        with pytest.raises(UsageError):
            render(layer.scene)


SPARSE, COMPLEX = torch.ones(SHAPE).to_sparse(), torch.ones(SHAPE) * 1j
TWO_PAIRS = {"sigma_a": torch.ones(1), "values": {"sigma_t": torch.ones(1)}}
TWICE = {"density": torch.ones(SHAPE), "values": {"density": torch.ones(SHAPE)}}
ALL_CAMERAS, NO_GLOW = {"views.*.camera": torch.zeros(6)}, {"emission": torch.zeros(1)}
CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "no file": (lambda: ddrecon.load_scene("none.yaml"), "none.yaml"),
    "half": (lambda: ddrecon.load_scene(BALL, dtype=torch.float16), "dtype torch.float16: "),
    "device": (lambda: ddrecon.load_scene(BALL, device="nowhere"), "device nowhere: "),
    "no path": (lambda: ddrecon.load_scene(small_layer().scene), "path: "),
    "one override": (lambda: ddrecon.load_scene(BALL, overrides="a=b"), "overrides: "),
    "film": (lambda: next(ddrecon.optimize_sequence(BALL, overrides="a=b")), "overrides: "),
    "no overrides": (lambda: ddrecon.load_scene(BALL, overrides=None), "overrides: "),
    "odd overrides": (lambda: ddrecon.load_scene(BALL, overrides=[3]), "overrides: "),
    "iterations": (lambda: ddrecon.optimize(ddrecon.load_scene(BALL), "many"), "iterations: "),
    "no views": (lambda: ddrecon.render(replace(small_layer().scene, views=[])), "no view"),
    "nothing": (lambda: small_layer()(density=torch.ones(0, *SHAPE)), "or hold nothing"),
    "engine": (lambda: ddrecon.use_engine("steam"), "engine steam: "),
    "a path to render": (lambda: ddrecon.render("a.yaml"), "expected a Scene, found str; "),
    "a path's fluence": (lambda: ddrecon.fluence("a.yaml"), "expected a Scene, found str; "),
    "a path as a layer": (lambda: VolumeRenderer("a.yaml"), "expected a Scene, found str; "),
    "a path to optimize": (lambda: ddrecon.optimize("a.yaml"), "expected a Scene, found str; "),
    "a number": (lambda: small_layer()(sigma_s=9.0), "sigma_s: expected a tensor"),
    "another number": (lambda: small_layer()(g=0.3), "g: expected a tensor"),
    "twice": (lambda: small_layer()(**TWICE), "density: given twice"),
    "two pairs": (lambda: small_layer()(**TWO_PAIRS), "sigma_a, sigma_t: "),
    "every view": (lambda: small_layer()(values=ALL_CAMERAS), "did you mean 'views.view.camera'"),
    "no glow": (lambda: small_layer()(values=NO_GLOW), "volume.emission = torch.zeros(1)"),
    "sparse": (lambda: small_layer()(SPARSE), "density: is torch.float32, t"),
    "complex": (lambda: small_layer()(COMPLEX), "density: is torch.complex64, torch"),
    "nowhere": (lambda: small_layer().to("meta")(), "density: has no numbers on the device meta"),
}


@pytest.mark.parametrize(("call", "problem"), CALLS.values(), ids=CALLS)
def test_all_that_a_user_can_cause_is_an_error_of_ours(call, problem):
    with pytest.raises(ddrecon.DdreconError, match=re.escape(problem)) as caught:
        call()
    assert "\n" not in str(caught.value)


SUN = DirectionalLight(tensor(0.0, -1.0, 0.0), 3.0)  # type: ignore[arg-type]
MIRRORED = torch.tensor([-1.0, 1, 1]).double().diag()[:, [0, 1, 2, 2]]
RECORDS: dict[str, list[Any]] = {
    "lights": [[SUN], [None]],
    "views": [[None]],
    "ground": [Ground(tensor(0.5), Plane(NAN, 1)), Ground(tensor(0.5), Plane(-9.0, 7))],
    "diffusion": [{}, DiffusionSettings(degree=4), DiffusionSettings(tolerance=NAN)],
    "render": [RenderSettings(samples_per_pixel=0)],
    "volume.phase": [None],
    "volume.black_body": [2000.0],
    "volume.support": [torch.ones(2, 2, 2)],
    "volume.index": [0.5],
    "views.0.exposure": [2.0],
    "views.0.offset": [torch.zeros(2, **DOUBLE)],
    "views.0.background": [torch.full((1, 1, 1), NAN), torch.ones(2), 0.5],
    "views.0.weight": [NAN],
    "views.0.step": [NAN],
    "views.0.image": [torch.ones(3, 5, 4)],
    "views.0.mask": [torch.ones(2, 5)],
    "views.0.camera.size": [(0, 4)],
    "views.0.camera.half_width": [0.0, "a"],
    "views.0.camera.pose": [torch.eye(4, **DOUBLE), 2 * torch.eye(3, 4, **DOUBLE), MIRRORED],
    "views.0.camera.principal_point": [[0.5], (0.5, NAN)],
    "views.0.camera.pixel_aspect": [0.0, NAN],
    "views.0.camera.lens": ["fish"],
    "views.0.camera.distortion": [None, torch.zeros(2, **DOUBLE)],
}


@pytest.mark.parametrize(
    ("place", "value"), [(place, value) for place, values in RECORDS.items() for value in values]
)
def test_no_part_of_a_scene_is_guessed(place, value):
    """Of scenes made in Python as of those in files; also where one is made of another."""
    scene = lens_layer().scene
    *owners, name = place.split(".")
    record: Any = scene
    for owner in owners:
        record = record[int(owner)] if owner.isdigit() else getattr(record, owner)
    setattr(record, name, value)
    scenes = [scene] if owners else [scene, replace(small_layer().scene, **{name: value})]
    for wrong in scenes:
        with pytest.raises(UsageError, match=f"view.*{name}" if "0" in place else place):
            render(wrong)


def test_one_precision_and_a_known_view():
    scene = small_layer().scene
    with pytest.raises(UsageError, match="no view 'side'; known: view"):
        render(scene, "side")
    scene.volume.sigma_a = scene.volume.sigma_a.float()
    with pytest.raises(UsageError, match=r"sigma_a: is torch\.float32 on cpu, but"):
        render(scene)


def test_what_torch_cannot_do_is_said():
    layer, density = small_layer(), random_values(*SHAPE).requires_grad_()

    def total(values):
        return layer(density=values).sum()

    with pytest.raises(NotImplementedError, match=r"vmap: .*VolumeRenderer takes batches, \[n, z"):
        torch.func.vmap(total)(density.detach().expand(2, *SHAPE))
    with pytest.raises(NotImplementedError, match=r"use torch\.autograd\.grad or backward"):
        torch.func.grad(total)(density.detach())
    for again in (
        lambda: torch.autograd.grad(total(density), density, create_graph=True),
        lambda: torch.autograd.functional.hessian(total, density.detach()),
    ):
        with pytest.raises(NotImplementedError, match="only first derivatives of light"):
            again()
    image = layer(density=density)
    both = torch.stack([image, image]).detach()
    with pytest.raises(NotImplementedError, match="light has one cotangent a pass"):
        torch.autograd.grad(image, density, both, is_grads_batched=True)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("rounds", [0, 1])
def test_a_change_in_place_before_the_backward_pass_is_noticed(engine, rounds):
    """As autograd does: what is computed again there would be that of other numbers."""
    ddrecon.use_engine(engine)
    scene = make_scene(random_values(*SHAPE), transport_rounds=rounds)
    density = scene.volume.density.requires_grad_()
    total = render(scene).sum()
    with torch.no_grad():
        density *= 2
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


@pytest.mark.slow
def test_the_compiler_leaves_it_alone():
    layer, density = small_layer(), random_values(*SHAPE)

    def network(strength):
        return layer(density=density * strength).sin() * 2

    strength = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
    torch._dynamo.utils.counters.clear()
    images, expected = torch.compile(network, backend="eager")(strength), network(strength)
    torch.testing.assert_close(images, expected, rtol=1e-5, atol=1e-7)
    counts = torch._dynamo.utils.counters["frames"]
    assert counts["total"] <= 3, "the frames inside were compiled"
