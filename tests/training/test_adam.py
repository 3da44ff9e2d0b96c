import copy

import pytest
import torch

from rapid.networks.denormals import no_denormals
from rapid.training.machinery.adam import Adam, clip_norm


def weights() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator, requires_grad=True) for shape in ((37, 5), (5,), ())]


def gradients(step: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(step)
    return [torch.randn(weight.shape, generator=generator) for weight in weights()]


def test_steps_are_those_of_torch_bit_for_bit():
    ours, theirs = weights(), weights()
    adam, reference = Adam(ours), torch.optim.Adam(theirs, lr=1e-2, fused=True)
    for step in range(1, 30):
        rate = 1e-2 / step
        adam.step(gradients(step), rate)
        for weight, gradient in zip(theirs, gradients(step), strict=True):
            weight.grad = gradient
        reference.param_groups[0]["lr"] = rate
        reference.step()
        assert all(map(torch.equal, ours, theirs))


def test_a_parameter_may_have_a_step_size_of_its_own():
    ours, theirs = weights(), weights()
    adam = Adam(ours, [1.0, 20.0, 1.0])
    groups = [{"params": [theirs[0], theirs[2]]}, {"params": [theirs[1]], "lr": 0.2}]
    reference = torch.optim.Adam(groups, lr=0.01, fused=True)
    for step in range(1, 9):
        adam.step(gradients(step), 0.01)
        for weight, gradient in zip(theirs, gradients(step), strict=True):
            weight.grad = gradient
        reference.step()
        assert all(map(torch.equal, ours, theirs))


@pytest.mark.parametrize("largest", [0.1, 100.0])
def test_clipping_is_that_of_torch_bit_for_bit(largest):
    ours, theirs = gradients(1), weights()
    for weight, gradient in zip(theirs, gradients(1), strict=True):
        weight.grad = gradient
    assert torch.equal(clip_norm(ours, largest), torch.nn.utils.clip_grad_norm_(theirs, largest))
    assert all(torch.equal(gradient, weight.grad) for gradient, weight in zip(ours, theirs, strict=True))


def test_a_saved_optimiser_goes_on_as_the_original():
    ours, theirs = weights(), weights()
    adam, copied = Adam(ours), Adam(theirs)
    for step in range(1, 5):
        adam.step(gradients(step), 1e-2)
    with torch.no_grad():
        for weight, value in zip(theirs, ours, strict=True):
            weight.copy_(value)
    copied.load_state_dict(copy.deepcopy(adam.state_dict()))
    for optimizer in (adam, copied):
        optimizer.step(gradients(9), 1e-2)
    assert all(map(torch.equal, ours, theirs))


def test_the_averages_of_weights_without_gradient_reach_zero_and_the_process_is_left_as_it_was():
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such mode")
    tiny = torch.full((1,), 1e-40)

    def mean_after(steps):
        weight = torch.zeros(1)
        adam = Adam([weight])
        adam.step([torch.ones(1)], 1e-3)
        for _ in range(steps):
            adam.step([torch.zeros(1)], 1e-3)
        return adam.state_dict()["mean"][0].item()

    assert 0 < mean_after(850) < 1.2e-38
    with no_denormals():
        assert mean_after(850) == 0
    assert (tiny * 1).item() > 0
    torch.set_flush_denormal(True)
    try:
        with no_denormals():
            pass
        assert (tiny * 1).item() == 0
    finally:
        torch.set_flush_denormal(False)
