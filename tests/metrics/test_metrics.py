import json
import math
import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.errors import InputError
from stereokit.metrics import (
    KITTI_METRICS,
    StereoMetrics,
    bad_pixels,
    count_pixels,
    d1,
    end_point_error,
    invalid_predictions,
    valid_pixels,
)
from stereokit.pictures import error_picture

NAN, INF = math.nan, math.inf
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA")),
]

# KITTI's numbers: whole multiples of 1/256. Errors sit on and next to both of D1's thresholds.
truths = st.one_of(
    st.integers(1, 300 * 256).map(lambda n: n / 256), st.sampled_from([0.0, NAN, INF, -1.0, 60.0, 100.0])
)
errors = st.one_of(
    st.integers(-20 * 256, 20 * 256).map(lambda n: n / 256),
    st.sampled_from([0.0, 3.0, -3.0, 3 + 1 / 256, 5.0, -5.0, 5 + 1 / 256, NAN, INF, -INF]),
)


@st.composite
def batches(draw, max_images=3):
    """(prediction, truth, nonoccluded, foreground), each (B, H, W)."""
    images, height, width = draw(st.integers(1, max_images)), draw(st.integers(1, 3)), draw(st.integers(1, 4))
    shape, size = (images, height, width), images * height * width

    def tensor(elements, dtype):
        return torch.tensor(draw(st.lists(elements, min_size=size, max_size=size)), dtype=dtype).reshape(shape)

    truth, error = tensor(truths, torch.float32), tensor(errors, torch.float32)
    known = torch.isfinite(truth)
    prediction = torch.where(known, truth, torch.zeros(())) + error
    return prediction, truth, tensor(st.booleans(), torch.bool), tensor(st.booleans(), torch.bool)


def pixels_of(*images):
    return zip(*(image.flatten().tolist() for image in images), strict=True)


def kitti_2015(prediction, truth, foreground):
    """D1-bg, D1-fg and D1-all after the definition, pixel by pixel: errors and pixels summed over images."""
    wrong, number = {"d1_bg": 0, "d1_fg": 0, "d1": 0}, {"d1_bg": 0, "d1_fg": 0, "d1": 0}
    for estimate, true, is_object in pixels_of(prediction, truth, foreground):
        if not (0 < true < INF):
            continue
        difference = abs(estimate - true)
        outlier = not math.isfinite(estimate) or (difference > 3 and 20 * difference > true)
        for name in ("d1", "d1_fg" if is_object else "d1_bg"):
            number[name] += 1
            wrong[name] += outlier
    return {name: 100 * wrong[name] / number[name] if number[name] else None for name in wrong}


def kitti_2012(prediction, truth, nonoccluded):
    """Out-Noc, Out-All, Avg-Noc, Avg-All after the definition: the mean of each image's own share or mean."""
    shares = {"Out-Noc": [], "Out-All": [], "Avg-Noc": [], "Avg-All": []}
    for image in zip(prediction, truth, nonoccluded, strict=True):
        for suffix in ("Noc", "All"):
            seen = [
                abs(estimate - true) if math.isfinite(estimate) else INF
                for estimate, true, in_both in pixels_of(*image)
                if 0 < true < INF and (in_both or suffix == "All")
            ]
            finite = [error for error in seen if error < INF]
            if seen:
                shares[f"Out-{suffix}"].append(100 * sum(error > 3 for error in seen) / len(seen))
            if finite:
                shares[f"Avg-{suffix}"].append(sum(finite) / len(finite))
    return {name: sum(values) / len(values) if values else None for name, values in shares.items()}


def results_of(prediction, truth, nonoccluded=None, foreground=None, **settings):
    metrics = StereoMetrics(**settings)
    metrics.update(prediction, truth, nonoccluded=nonoccluded, foreground=foreground)
    return metrics.compute()


def same(first, second):
    assert first.keys() == second.keys()
    for name, value in first.items():
        close = value is not None and second[name] is not None and math.isclose(value, second[name])
        assert value == second[name] or close, name
    return True


@given(batches())
def test_it_agrees_with_a_transcription_of_kittis_definitions(batch):
    prediction, truth, nonoccluded, foreground = batch
    results = results_of(*batch)
    expected = kitti_2015(prediction, truth, foreground)
    assert {name: results[name] for name in expected} == pytest.approx(expected)
    expected = kitti_2012(prediction, truth, nonoccluded)
    assert {name: results[KITTI_METRICS[name]] for name in expected} == pytest.approx(expected)


@given(batches(), st.sampled_from([None, 10.0, 100.0, 200.0]))
def test_the_functions_and_the_accumulator_agree(batch, max_disparity):
    prediction, truth, nonoccluded, foreground = batch
    results = results_of(*batch, max_disparity=max_disparity)
    regions = {"": None, "_noc": nonoccluded, "_occ": ~nonoccluded, "_bg": ~foreground, "_fg": foreground}
    for suffix, mask in regions.items():
        arguments = {"mask": mask, "max_disparity": max_disparity}
        assert results[f"epe{suffix}"] == pytest.approx(end_point_error(prediction, truth, **arguments))
        assert results[f"bad_2{suffix}"] == bad_pixels(prediction, truth, 2, **arguments)
        assert results[f"d1{suffix}"] == d1(prediction, truth, **arguments)
        assert results[f"pixels{suffix}"] == int(valid_pixels(truth, **arguments).sum())
        assert results[f"invalid_predictions{suffix}"] == invalid_predictions(prediction, truth, **arguments)


@given(batches(), st.randoms(use_true_random=False))
def test_the_order_of_pixels_and_of_images_does_not_matter(batch, chance):
    images, pixels = list(range(len(batch[0]))), list(range(batch[0][0].numel()))
    chance.shuffle(images)
    chance.shuffle(pixels)
    shuffled = [tensor[images].flatten(1)[:, pixels].reshape(tensor.shape) for tensor in batch]
    assert same(results_of(*batch), results_of(*shuffled))


@given(batches(), st.lists(st.floats(0, 30), min_size=2, max_size=5, unique_by=lambda tau: f"{tau:g}"))
def test_a_larger_threshold_never_finds_more_bad_pixels(batch, taus):
    prediction, truth, _, _ = batch
    shares = [bad_pixels(prediction, truth, tau) for tau in sorted(taus)]
    if None in shares:
        assert set(shares) == {None}
    else:
        assert shares == sorted(shares, reverse=True)
        assert d1(prediction, truth) <= bad_pixels(prediction, truth, 3)
    results = results_of(*batch, taus=taus)
    assert [results[f"bad_{tau:g}"] for tau in sorted(taus)] == shares


@given(st.lists(batches(), min_size=1, max_size=4), st.integers(0, 4))
def test_merging_equals_pooling(parts, cut):
    def accumulated(batches):
        metrics = StereoMetrics(max_disparity=200)
        for prediction, truth, nonoccluded, foreground in batches:
            metrics.update(prediction, truth, nonoccluded=nonoccluded, foreground=foreground)
        return metrics

    merged = accumulated(parts[:cut]).merge(accumulated(parts[cut:]))
    assert same(merged.compute(), accumulated(parts).compute())
    # One image at a time, of whatever size, is the same again.
    single = [[tensor[i : i + 1] for tensor in batch] for batch in parts for i in range(len(batch[0]))]
    assert same(accumulated(single).compute(), accumulated(parts).compute())


@given(batches())
def test_regions_split_all_pixels(batch):
    results = results_of(*batch)
    for one, other in (("noc", "occ"), ("bg", "fg")):
        for count in ("pixels", "invalid_predictions"):
            assert results[f"{count}_{one}"] + results[f"{count}_{other}"] == results[count]
        shares = [(results[f"d1_{r}"] or 0) * results[f"pixels_{r}"] for r in (one, other)]
        assert sum(shares) == pytest.approx((results["d1"] or 0) * results["pixels"])


@given(batches())
def test_the_state_survives_json(batch):
    metrics = StereoMetrics(taus=(0.5, 3), max_disparity=150)
    metrics.update(*batch[:2], nonoccluded=batch[2])
    state = json.loads(json.dumps(metrics.state_dict()))
    restored = StereoMetrics.from_state_dict(state)
    assert restored.compute() == metrics.compute()
    assert restored.state_dict() == metrics.state_dict()


def test_pooled_and_per_image_means_differ_as_named():
    truth = torch.tensor([[[10.0, 10.0, 10.0]], [[10.0, 0.0, NAN]]])
    prediction = torch.tensor([[[10.0, 10.0, 10.0]], [[18.0, 10.0, 10.0]]])
    results = results_of(prediction, truth)
    assert results["epe"] == 2.0
    assert results["epe_per_image"] == 4.0
    assert results["d1"] == 25.0
    assert results["d1_per_image"] == 50.0


def test_no_pixels_are_none_and_never_a_number():
    empty = torch.zeros(2, 3, 4)
    assert end_point_error(empty, empty) is None
    assert bad_pixels(empty, empty, 3) is None
    assert d1(empty, empty) is None
    assert invalid_predictions(empty, empty) == 0
    nowhere = torch.zeros_like(empty, dtype=torch.bool)
    results = results_of(empty + NAN, empty, nowhere, nowhere)
    counts = ("pixels", "images", "invalid_predictions")
    for name, value in results.items():
        if name.startswith("images_without_pixels"):
            assert value == 2
        else:
            assert value == (0 if name.startswith(counts) else None), name
    assert results_of(empty, empty + 5, nowhere)["d1_noc"] is None
    assert StereoMetrics().compute()["epe"] is None


def test_an_image_without_pixels_is_counted_and_moves_no_mean():
    truth = torch.tensor([[[10.0, 20.0]], [[0.0, NAN]]])
    results = results_of(truth.nan_to_num() + 4, truth)
    assert results["d1_per_image"] == 100.0
    assert results["epe_per_image"] == 4.0
    assert (results["images"], results["images_without_pixels"]) == (1, 1)


@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_invalid_predictions_are_errors_and_are_counted(value):
    truth = torch.tensor([[[10.0, 20.0, 30.0, 0.0]]])
    prediction = torch.tensor([[[value, 21.0, 30.0, value]]])
    results = results_of(prediction, truth, taus=(3, 1e9))
    assert results["invalid_predictions"] == 1
    assert results["d1"] == results["bad_3"] == results["bad_1e+09"] == pytest.approx(100 / 3)
    assert results["epe"] == 0.5
    assert results["pixels"] == 3
    nothing = results_of(prediction * NAN, truth)
    assert nothing["epe"] is None
    assert nothing["epe_per_image"] is None
    assert nothing["d1"] == 100.0
    assert nothing["images"] == 1


def test_both_thresholds_are_exclusive():
    truth = torch.tensor([10.0, 60.0, 100.0, 80.0, 100.0, 100.0])
    prediction = torch.tensor([13.0, 63.0, 105.0, 76.0, 105.125, 94.875])
    outliers = [d1(p[None], t[None]) for p, t in zip(prediction, truth, strict=True)]
    assert outliers == [0, 0, 0, 0, 100, 100]
    assert bad_pixels(prediction[:2], truth[:2], 3) == 0
    assert bad_pixels(prediction[:2], truth[:2], np.nextafter(3, 0)) == 100


def test_the_ceiling_is_exclusive_and_only_of_the_truth():
    truth = torch.tensor([[[191.0, 192.0, 193.0]]])
    results = results_of(truth + 500, truth, max_disparity=192)
    assert results["pixels"] == 1
    assert results["epe"] == 500.0
    assert results_of(truth, truth)["pixels"] == 3


@given(batches())
def test_d1_counts_what_the_error_picture_shows_as_wrong(batch):
    prediction, truth = batch[0].flatten(0, 1), batch[1].flatten(0, 1)
    picture = error_picture(prediction, truth, dilate=0).astype(int)
    shown = picture.sum(axis=2) > 0
    warm = shown & (picture[..., 0] >= picture[..., 2])
    expected = 100 * warm.sum() / shown.sum() if shown.any() else None
    assert d1(prediction, truth) == pytest.approx(expected)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_any_device_and_type_gives_the_same(device, dtype):
    random.seed(0)
    truth = torch.tensor([[[random.randint(0, 120) * 1.0 for _ in range(50)] for _ in range(40)]] * 2)
    prediction = truth + torch.tensor([[[random.choice([0, 1, 3, 4, 6, NAN]) for _ in range(50)] for _ in range(40)]])
    nonoccluded = truth > 60
    expected = results_of(prediction, truth, nonoccluded)
    metrics = StereoMetrics()
    metrics.update(prediction.to(device, dtype).requires_grad_(), truth, nonoccluded=nonoccluded)
    assert metrics.compute() == expected
    assert d1(prediction.to(device, dtype), truth.to(device)) == expected["d1"]


def test_a_coarse_prediction_is_compared_with_the_exact_truth():
    truth = torch.tensor([100.3125])
    assert end_point_error(torch.tensor([100.0], dtype=torch.bfloat16), truth) == 0.3125


def test_sums_of_a_whole_data_set_keep_every_pixel():
    metrics = StereoMetrics(taus=(2,))
    metrics.update(torch.tensor([[[11.0]]]), torch.tensor([[[10.0]]]))
    for _ in range(30):
        metrics.merge(metrics)
    metrics.update(torch.tensor([[[14.0]]]), torch.tensor([[[10.0]]]))
    results = metrics.compute()
    assert results["pixels"] == results["images"] == 2**30 + 1
    assert results["epe"] * (2**30 + 1) == pytest.approx(2**30 + 4, abs=0.01)
    assert results["bad_2"] == 100 / (2**30 + 1)


def test_regions_that_no_update_named_are_absent():
    truth = torch.ones(1, 2, 2)
    metrics = StereoMetrics()
    metrics.update(truth, truth)
    assert not any(name.endswith(("_noc", "_occ", "_bg", "_fg")) for name in metrics.compute())
    metrics.update(truth, truth, nonoccluded=truth > 0)
    results = metrics.compute()
    assert (results["images"], results["images_noc"], results["images_occ"]) == (2, 1, 0)
    assert "d1_fg" not in results


def test_kittis_names_lead_to_results():
    everywhere = torch.ones(1, 2, 2, dtype=torch.bool)
    results = results_of(torch.ones(1, 2, 2), torch.ones(1, 2, 2), everywhere, everywhere)
    assert set(KITTI_METRICS.values()) <= set(results)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"prediction": torch.ones(1, 1, 2, 2)}, r"\(1, 1, 2, 2\) and truth \(1, 2, 2\)"),
        (
            {"prediction": torch.ones(2, 2), "truth": torch.ones(2, 2)},
            r"expected a batch of maps, \(B, H, W\)",
        ),
        ({"prediction": torch.ones(1, 2, 2, dtype=torch.int16)}, "prediction is torch.int16"),
        ({"truth": np.ones((1, 2, 2), np.float32)}, r"truth is ndarray; .* floating-point torch\.Tensor"),
        ({"nonoccluded": torch.ones(1, 2, 2)}, "nonoccluded is torch.float32"),
        ({"foreground": torch.ones(1, 2, 3, dtype=torch.bool)}, r"foreground .* \(1, 2, 3\)"),
    ],
)
def test_what_does_not_fit_is_refused_and_leaves_no_trace(change, said):
    arguments = {"prediction": torch.ones(1, 2, 2), "truth": torch.ones(1, 2, 2), **change}
    metrics = StereoMetrics()
    with pytest.raises(InputError, match=said):
        metrics.update(**arguments)
    assert metrics.state_dict() == StereoMetrics().state_dict()


def test_settings_that_make_no_sense_are_refused():
    for taus in [(-1,), (NAN,), (INF,), (3, 3.0)]:
        with pytest.raises(InputError, match="tau"):
            StereoMetrics(taus=taus)
    for ceiling in (0, -1, NAN, INF):
        with pytest.raises(InputError, match="max_disparity is"):
            StereoMetrics(max_disparity=ceiling)
        with pytest.raises(InputError, match="max_disparity is"):
            valid_pixels(torch.ones(2), max_disparity=ceiling)
    with pytest.raises(InputError, match=r"mask is torch\.uint8"):
        d1(torch.ones(2), torch.ones(2), torch.ones(2, dtype=torch.uint8))


def test_other_rules_are_not_merged():
    with pytest.raises(InputError, match=r"max_disparity=192\.0 and max_disparity=None"):
        StereoMetrics(max_disparity=192).merge(StereoMetrics())
    with pytest.raises(InputError, match="taus"):
        StereoMetrics(taus=(1,)).merge(StereoMetrics())


@pytest.mark.parametrize(
    "change",
    [
        {"sums": [1.0]},
        {"pixels": "many"},
        {"seen": [[0], [0, 1]]},
        {"taus": None},
        {"taus": ["x"]},
        {"max_disparity": "high"},
        {"more": 1},
    ],
)
def test_a_damaged_state_is_refused(change):
    with pytest.raises(InputError, match="the metrics' state"):
        StereoMetrics.from_state_dict({**StereoMetrics().state_dict(), **change})


def accumulate_share(rank, world, store, results):
    torch.distributed.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=world)
    truth = torch.full((1, 2, 3), 10.0 + rank)
    metrics = StereoMetrics()
    metrics.update(truth + 4 * rank, truth)
    merged = metrics.merged_over_processes()
    results[rank] = (merged.compute(), metrics.compute()["images"])
    torch.distributed.destroy_process_group()


def test_one_process_is_merged_with_itself_only(tmp_path):
    results = {}
    accumulate_share(0, 1, tmp_path / "store", results)
    assert results[0][0]["images"] == 1
    metrics = StereoMetrics()
    metrics.update(torch.ones(1, 1, 1), torch.ones(1, 1, 1))
    alone = metrics.merged_over_processes()
    assert alone.compute() == metrics.compute()
    assert alone is not metrics


@pytest.mark.slow
def test_processes_merge_to_the_same_sum(tmp_path):
    context = torch.multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        results = manager.dict()
        torch.multiprocessing.spawn(accumulate_share, (3, tmp_path / "store", results), nprocs=3)
        merged, own = zip(*(results[rank] for rank in range(3)), strict=True)
    assert own == (1, 1, 1)
    assert merged[0] == merged[1] == merged[2]
    assert merged[0]["images"] == 3
    assert merged[0]["epe"] == pytest.approx(4.0)
    assert merged[0]["d1"] == pytest.approx(200 / 3)


@settings(max_examples=20)
@given(batches())
def test_nothing_given_is_changed(batch):
    before = [tensor.clone() for tensor in batch]
    results_of(*batch, max_disparity=50)
    assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(before, batch, strict=True))


@given(
    st.lists(st.one_of(st.floats(width=32), st.sampled_from([0.0, -0.0, NAN, INF, -INF, 192.0])), min_size=1),
    st.one_of(st.none(), st.floats(1, 300, width=32)),
)
def test_each_pixel_falls_under_one_rule(values, ceiling):
    truth = torch.tensor(values, dtype=torch.float32)
    counts = count_pixels(truth, max_disparity=ceiling)
    assert counts.total == len(values)
    assert counts.valid == valid_pixels(truth, max_disparity=ceiling).sum()
    assert counts.not_finite == sum(not math.isfinite(value) for value in truth.tolist())
    assert counts.zero == sum(value == 0 for value in truth.tolist())
    assert counts.negative == sum(-INF < value < 0 for value in truth.tolist())
    assert counts.too_large == sum(ceiling is not None and ceiling <= value < INF for value in truth.tolist())
    assert counts.known == counts.valid + counts.negative + counts.too_large
    assert count_pixels(truth[:1], max_disparity=ceiling) + count_pixels(truth[1:], max_disparity=ceiling) == counts
    assert count_pixels(truth.numpy(), max_disparity=ceiling) == counts
