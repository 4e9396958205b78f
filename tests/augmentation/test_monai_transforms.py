"""MONAI transform for random elastic deformations."""

import warnings
from functools import cache

import numpy as np
import pytest

from napari_hmrf import ArgumentError, Material, ProblemError
from napari_hmrf.random import RandomDeformation
from napari_hmrf.tissue import RIGID

pytestmark = pytest.mark.filterwarnings("ignore")

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    monai = pytest.importorskip("monai")
    torch = pytest.importorskip("torch")
    from monai.data import DataLoader, Dataset, MetaTensor
    from monai.transforms import Compose, RandFlipd

    from napari_hmrf.random import RandPhysicalDeformationd

MATERIALS = Material(0, "muscle", 3.0), Material(1, "bone", RIGID)


@cache
def labels(axes=2):
    image = np.zeros((24,) * axes, np.uint8)
    image[(slice(8, 14),) * axes] = 1
    return image


@cache
def deformation(axes=2):
    return RandomDeformation(labels(axes), MATERIALS, amplitude=2, patches=3, radius=1.5, spacing=1)


def data(axes=2):
    image = np.random.default_rng(0).random((2, *labels(axes).shape), dtype=np.float32)
    return {"image": image, "label": labels(axes)[None], "name": "case 1"}


def transform(axes=2, prob=1.0, seed=3, **more):
    modes = "bilinear", "nearest"
    made = RandPhysicalDeformationd(
        ("image", "label"), deformation(axes), prob=prob, mode=modes, **more
    )
    return made.set_random_state(seed)


@pytest.mark.parametrize("axes", [2, 3])
def test_image_and_labels_move_by_the_same_field(axes):
    given = data(axes)
    found = transform(axes)(given)
    assert found["name"] == "case 1"
    assert found["image"].shape == given["image"].shape
    assert found["label"].dtype == np.uint8
    assert set(np.unique(found["label"])) == {0, 1}
    seed = np.random.RandomState(3)
    seed.rand()
    sample = deformation(axes).sample(int(seed.randint(2**31 - 1)))
    np.testing.assert_array_equal(found["label"][0], sample.labels(labels(axes)))
    for channel, moved in zip(given["image"], found["image"], strict=True):
        np.testing.assert_allclose(moved, sample.image(channel), atol=1e-6)


def test_tensors_keep_their_type_and_metadata():
    given = data()
    tensor, meta = torch.as_tensor(given["image"]), MetaTensor(given["image"])
    meta.meta["patient"] = 7
    whole = transform()(given)
    for image in (tensor, meta):
        found = transform()({**given, "image": image})["image"]
        assert type(found) is type(image)
        np.testing.assert_array_equal(np.asarray(found), whole["image"])
    assert found.meta["patient"] == 7


def test_a_seed_reproduces_results_and_a_probability_skips_some_images():
    once, again = (transform(seed=5)(data())["image"] for _ in range(2))
    np.testing.assert_array_equal(once, again)
    sometimes = transform(prob=0.5)
    moved = [not np.array_equal(sometimes(data())["image"], data()["image"]) for _ in range(20)]
    assert 3 < sum(moved) < 17


def test_the_transform_composes_with_other_transforms():
    chain = Compose([RandFlipd("image", prob=0.0), transform()]).set_random_state(1)
    assert chain(data())["label"].shape == (1, 24, 24)


def test_a_callable_chooses_the_deformation_of_each_dictionary():
    asked = []

    def deformation_of_case(found):
        asked.append(found["name"])
        return deformation()

    made = RandPhysicalDeformationd("image", deformation_of_case, prob=1.0)
    made(data())
    assert asked == ["case 1"]


def test_a_missing_key_is_an_error_unless_it_is_allowed():
    image = {"image": data()["image"]}
    with pytest.raises(KeyError, match="label"):
        transform()(image)
    assert "label" not in transform(allow_missing_keys=True)(image)


def test_the_transform_runs_in_data_loader_workers():
    transform()(data())  # the parent process computes before it forks
    loader = DataLoader(Dataset([data()] * 4, transform()), batch_size=2, num_workers=1)
    batches = [batch["image"].shape for batch in loader]
    assert batches == [(2, 2, 24, 24)] * 2


def test_invalid_arguments_are_rejected():
    with pytest.raises(ArgumentError, match="mode must be"):
        RandPhysicalDeformationd("image", deformation(), mode="cubic")
    with pytest.raises(ArgumentError, match="deformation must be"):
        RandPhysicalDeformationd("image", "elastic")
    with pytest.raises(ProblemError, match="image"):
        transform()({"image": np.zeros((1, 5, 5)), "label": np.zeros((1, 5, 5), int)})
