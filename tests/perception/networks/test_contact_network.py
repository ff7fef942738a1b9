from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from touchcell.perception.models.architecture import LOG_PRECISION_BOUNDS, MEAN_BOUNDS, Architecture  # noqa: E402
from touchcell.perception.models.model_file import Labels  # noqa: E402
from touchcell.perception.networks.contact_network import (  # noqa: E402
    Alignment,
    ContactNetwork,
    gaussian_loss,
    softbound,
    weighted_absolute_loss,
    weighted_square_loss,
)

BOUNDS = [MEAN_BOUNDS, LOG_PRECISION_BOUNDS, (0.0, 1.0), (1e-6, 1e6**0.25), (-20.0, 20.0), (5.0, 5.5)]
SMALL = Architecture(input_size=(32, 32), channels=(4, 8), hidden=16)


def float32_sweep() -> torch.Tensor:
    """Values of every float32 exponent and both signs, the ends of the range and infinities, in rising order."""
    bits = np.arange(0, 0x7F80_0000, 0x0001_3579, dtype=np.uint32)
    positive = np.append(bits.view(np.float32), [np.finfo(np.float32).max, np.inf]).astype(np.float32)
    near = np.linspace(-60, 60, 20001, dtype=np.float32)
    return torch.from_numpy(np.unique(np.concatenate([-positive, positive, near])))


@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_softbound_never_leaves_its_bounds_and_rises(low: float, high: float) -> None:
    x = float32_sweep().requires_grad_()
    bounded = softbound(x, low, high)
    lowest, highest = np.float32(low), np.float32(high)
    values = bounded.detach().numpy()
    assert values.min() >= lowest
    assert values.max() <= highest
    assert values[0] == pytest.approx(lowest, abs=1e-6)
    assert values[-1] == pytest.approx(highest, rel=1e-6)
    steps = np.diff(values)
    # Exponential and logarithm are each accurate to an ulp, so a decrease within one is a tie.
    assert steps.min() >= -np.spacing(np.float32(max(abs(low), abs(high), high - low)))
    bounded.sum().backward()
    assert torch.isfinite(x.grad).all()
    assert x.grad.min() >= 0.0
    assert x.grad.max() <= 1.0 + 1e-5


@given(st.floats(-50, 50), st.floats(-10, 10), st.floats(0.1, 20))
def test_softbound_is_the_papers_function(x: float, low: float, width: float) -> None:
    exact = low + math.log1p(math.exp(x - low)) - math.log1p(math.exp(x - low - width))
    result = softbound(torch.tensor([x], dtype=torch.float64), low, low + width)
    assert result.item() == pytest.approx(exact, abs=1e-9)


def test_the_naive_form_does_leave_its_bounds() -> None:
    x = torch.tensor([1e9, math.inf])
    naive = 1e-6 + torch.nn.functional.softplus(x - 1e-6) - torch.nn.functional.softplus(x - 10.0)
    assert naive[0] < 1e-6
    assert torch.isnan(naive[1])
    torch.testing.assert_close(softbound(x, 1e-6, 10.0), torch.tensor([10.0, 10.0]))


def test_softbound_propagates_nan_to_the_loss() -> None:
    assert torch.isnan(softbound(torch.tensor([math.nan]), -1.0, 1.0)).all()


@pytest.mark.parametrize(("kind", "outputs"), [("gdn", 12), ("cnn", 6)])
def test_outputs(kind: str, outputs: int) -> None:
    torch.manual_seed(0)
    network = ContactNetwork(SMALL.model_copy(update={"kind": kind})).eval()
    result = network(torch.rand(5, 1, 32, 32))
    assert result.shape == (5, outputs)
    extreme = network(1e30 * torch.randn(50, 1, 32, 32))
    assert torch.isfinite(extreme).all()
    if kind == "gdn":
        assert extreme[:, :6].abs().max() <= 3.0
        assert extreme[:, 6:].min() >= LOG_PRECISION_BOUNDS[0]
        assert extreme[:, 6:].max() <= LOG_PRECISION_BOUNDS[1]


def test_every_output_has_its_own_dropout_rate() -> None:
    torch.manual_seed(0)
    rates = (0.0, 0.5, 0.0, 0.0, 0.0, 0.9)
    architecture = Architecture(
        input_size=(32, 32),
        channels=(4,),
        hidden=64,
        feature_dropout=0.0,
        mean_dropout=rates,
        precision_dropout=(0.0, 0.0, 0.3, 0.0, 0.0, 0.0),
    )
    network = ContactNetwork(architecture)
    image = torch.rand(1, 1, 32, 32).expand(3000, -1, -1, -1)
    with torch.no_grad():
        trained = network.train()._each_output_behind_its_own_dropout(torch.ones(3000, 64))
        exact = network.output(torch.ones(1, 64))[0]
    spread = trained.std(0)
    random = torch.tensor([rate > 0 for rate in (*rates, 0, 0, 0.3, 0, 0, 0)])
    assert (spread[~random] == 0).all()
    assert (spread[random] > 0).all()
    # Dropout keeps the mean, with variance rate / (1 - rate) times the squared terms.
    weights = network.output.weight.detach()
    rate = torch.tensor((*rates, 0, 0, 0.3, 0, 0, 0))
    expected = (rate / (1 - rate) * weights.square().sum(1)).sqrt()
    torch.testing.assert_close(spread[random], expected[random], rtol=0.1, atol=0.0)
    torch.testing.assert_close(trained.mean(0), exact, rtol=0.0, atol=float(4 * expected.max() / math.sqrt(3000)))
    assert network(image).shape == (3000, 12)


def test_pooling_before_normalising_is_the_papers_block() -> None:
    torch.manual_seed(1)
    network = ContactNetwork(SMALL)
    network.train()(torch.rand(16, 1, 32, 32))
    with torch.no_grad():
        for normalisation in network.normalisations:
            normalisation.bias.normal_()
    x = images = torch.rand(3, 1, 32, 32)
    network.eval()
    with torch.no_grad():
        for convolution, normalisation in zip(network.convolutions, network.normalisations, strict=True):
            x = torch.nn.functional.max_pool2d(torch.relu(normalisation(convolution(x))), 2)
        x = torch.relu(network.hidden(x.flatten(1)))
        expected = softbound(network.output(x), network.low, network.high)
        torch.testing.assert_close(network(images), expected)


def test_folded_tensors_are_those_that_the_architecture_names() -> None:
    folded = ContactNetwork(SMALL).folded()
    assert {name: tensor.shape for name, tensor in folded.items()} == SMALL.tensor_shapes()


def test_losses_are_their_formulas() -> None:
    rng = np.random.default_rng(0)
    outputs, labels = rng.normal(size=(7, 12)), rng.normal(size=(7, 6))
    sigma = np.exp(-outputs[:, 6:])
    density = np.exp(-0.5 * ((labels - outputs[:, :6]) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    plain = Alignment(Labels(low=(-1.0,) * 6, high=(1.0,) * 6))
    likelihood = gaussian_loss(torch.tensor(outputs), torch.tensor(labels), plain).item()
    assert likelihood == pytest.approx(-np.log(density).sum(axis=1).mean(), rel=1e-12)
    weights = np.arange(1.0, 7.0)
    error = outputs[:, :6] - labels
    square = weighted_square_loss(torch.tensor(outputs), torch.tensor(labels), torch.tensor(weights)).item()
    assert square == pytest.approx((weights * error**2).sum(axis=1).mean(), rel=1e-12)
    absolute = weighted_absolute_loss(torch.tensor(outputs), torch.tensor(labels), torch.tensor(weights)).item()
    assert absolute == pytest.approx((weights * np.abs(error)).sum(axis=1).mean(), rel=1e-12)


def test_alignment_is_that_of_the_labels_and_keeps_the_direction_out_of_the_gradient() -> None:
    rng = np.random.default_rng(1)
    labels = Labels.of_contacts((-5.0, -4.0, 0.0, -1.0, -1.0, -1.0), (5.0, 4.4, 1.0, 1.0, 1.0, 1.0))
    residual, mean = rng.normal(size=(2, 9, 6))
    inputs = [torch.tensor(array, dtype=torch.float32, requires_grad=True) for array in (residual, mean)]
    aligned = Alignment(labels)(*inputs)
    np.testing.assert_allclose(aligned.detach().numpy(), labels.aligned(residual, mean), atol=1e-5)
    aligned.sum().backward()
    assert inputs[0].grad is not None
    assert inputs[1].grad is None
    nothing = Alignment(labels)(inputs[0], torch.tensor(-labels.centre / labels.half_range, dtype=torch.float32))
    assert torch.isfinite(nothing).all()


def test_architecture_that_leaves_no_pixel_is_refused() -> None:
    with pytest.raises(ValueError, match="halvings"):
        Architecture(input_size=(16, 16), channels=(4, 4, 4, 4, 4))
