"""The pretended CUDA device: refuses what CUDA refuses, counts what it would pay for, changes no number."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from device_counts import DOWN, KERNELS, UP, WAITS
from pretended_device import pretended_cuda
from safetensors.torch import load_file, save_file
from torch import nn
from torch.utils.checkpoint import checkpoint

from wm_nodes.core.device import compute_device, device_label
from wm_nodes.world_model.precision import compute_context, cpu_has_fast_bfloat16

CUDA = torch.device("cuda", 0)


@pytest.fixture
def counts():
    with pretended_cuda() as counts:
        yield counts


def cost(counts):
    found = counts.kernels, counts.waits, counts.copies_up, counts.copies_down
    counts.reset()
    return found


def on_device(*shape, **options):
    return torch.ones(*shape, device="cuda", **options)


def test_the_device_is_there_inside_and_gone_outside():
    outside = torch.cuda.is_available(), torch.cuda.device_count(), torch.autocast.__init__
    with pretended_cuda():
        assert compute_device("cuda") == compute_device("auto") == CUDA
        assert device_label(CUDA) == "cuda:0 (pretended)"
        assert torch.cuda.device_count() == 1
        assert torch.cuda.is_bf16_supported() == cpu_has_fast_bfloat16()
        x = on_device(2)
        assert x.device == CUDA and x.is_cuda and not x.is_cpu and x.get_device() == 0
        with compute_context(x.device), torch.autocast("cuda", dtype=torch.bfloat16):
            assert (on_device(2, 2) @ on_device(2, 2)).dtype == torch.bfloat16
    assert outside == (torch.cuda.is_available(), torch.cuda.device_count(), torch.autocast.__init__)
    assert x.device == torch.device("cpu")


@pytest.mark.parametrize("mixed", [
    lambda x, y: x + y,
    lambda x, y: y * x,
    lambda x, y: x @ y,
    lambda x, y: x.add_(y),
    lambda x, y: torch.cat([x, y]),
    lambda x, y: torch.stack([x, y]),
    lambda x, y: torch.cat([x[0], y[0, 0][None]]),
    lambda x, y: torch.where(y > 0, x, 0.0),
    lambda x, y: x.masked_fill(y > 0, 0.0),
    lambda x, y: torch.add(x, x, out=y),
    lambda x, y: y[0, 0].add_(x[0, 0]),
    lambda x, y: nn.functional.linear(x, y),
    lambda x, y: nn.functional.embedding(y.long(), x),
    lambda x, y: x.gather(0, y.long()),
    lambda x, y: x.index_select(0, y[0, 0].long()),
    lambda x, y: nn.Linear(3, 3).to("cuda")(y),
    lambda x, y: x.index_put_((y[:, 0].long(),), y),
    lambda x, y: y.index_put_((y[:, 0].long(),), x),
    lambda x, y: torch._foreach_add([x], [y]),
    lambda x, y: torch.equal(x, y),
])
def test_operands_on_two_devices_are_refused(counts, mixed):
    with pytest.raises(RuntimeError, match="Expected all tensors to be on the same device, but found at least two"):
        mixed(on_device(3, 3), torch.ones(3, 3))
    with torch.inference_mode(), pytest.raises(RuntimeError, match="Expected all tensors to be on the same device"):
        mixed(on_device(3, 3), torch.ones(3, 3))
    mixed(on_device(3, 3), on_device(3, 3))


def test_numpy_does_not_see_device_memory(counts):
    for read in (torch.Tensor.numpy, np.asarray, np.array, lambda x: x.detach().numpy()):
        with pytest.raises(TypeError, match=r"can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu\(\)"):
            read(on_device(3))
        assert read(on_device(3).cpu()).tolist() == [1, 1, 1]


@pytest.mark.parametrize("draw", [
    lambda g: torch.rand(3, generator=g, device="cuda"),
    lambda g: torch.randn(3, generator=g, device="cuda"),
    lambda g: torch.randperm(3, generator=g, device="cuda"),
    lambda g: torch.randint(3, (2,), generator=g, device="cuda"),
    lambda g: on_device(3).normal_(generator=g),
    lambda g: torch.multinomial(on_device(3), 1, generator=g),
])
def test_a_generator_of_the_cpu_draws_nothing_on_the_device(counts, draw):
    with pytest.raises(RuntimeError, match="Expected a 'cuda' device type for generator but found 'cpu'"):
        draw(torch.Generator())
    draw(None)
    torch.rand(3, generator=torch.Generator()).to("cuda")


def test_an_index_of_the_device_does_not_read_a_cpu_tensor_and_one_of_the_cpu_is_copied(counts):
    here, there = torch.arange(4.0), torch.arange(4.0).to("cuda")
    for index in (torch.tensor([1]).to("cuda"), there > 2):
        with pytest.raises(RuntimeError, match=r"indices should be either on cpu or on the same device as the indexed"):
            here[index]
    counts.reset()
    assert there[torch.tensor([3, 1])].tolist() == [3, 1]
    assert cost(counts) == (1, 1, 1, 1)
    there[torch.tensor([3, 1])] = 7.0
    assert cost(counts) == (1, 0, 1, 0)
    assert there.tolist() == [0, 7, 2, 7]


def test_numbers_of_the_cpu_may_meet_the_device(counts):
    x = on_device(3)
    half = torch.tensor(0.5)
    for out in (x * half, half * x, x.mul(0.5), torch.where(x > 2, x, half), x.clone().mul_(half), half + x.sum()):
        assert out.is_cuda
    assert (x == 1).all().is_cuda


def test_each_way_to_make_a_tensor_puts_it_where_it_says(counts):
    given = [
        torch.zeros(2, device="cuda"), torch.empty(2, device="cuda:0"), torch.tensor([1.0], device="cuda"),
        torch.as_tensor(np.ones(2), device="cuda"), torch.as_tensor(on_device(2), device="cuda"),
        torch.tensor([1.0]).to(CUDA), torch.ones(2).to(device="cuda", dtype=torch.float64), torch.ones(2).cuda(),
        torch.ones(2).to("cuda", torch.float16), torch.ones(2).to(on_device(1)), torch.arange(3, device=CUDA),
        torch.zeros_like(torch.ones(2), device="cuda"), torch.ones(2).new_zeros(2, device="cuda"),
    ]
    x = on_device(2)
    derived = [
        x + 1, x.clone(), x.detach(), x[0], x.view(1, 2), x.to(torch.float64), x.half(), x.new_zeros(3),
        x.new_tensor([1.0]), torch.empty_like(x), torch.full_like(x, 2.0), copy.deepcopy(x), copy.copy(x),
        nn.Parameter(x), x.sort().values, torch.add(x, x, out=torch.empty_like(x)), x.split(1)[1],
    ]
    assert [t.device for t in (*given, *derived)] == [CUDA] * (len(given) + len(derived))
    back = [
        x.cpu(), x.to("cpu"), x.to(torch.ones(1)), torch.zeros_like(x, device="cpu"), x.new_zeros(2, device="cpu"),
        x.to(device="cpu", dtype=torch.float64), torch.as_tensor(x, device="cpu"), torch.ones(2).new_tensor([1.0]),
    ]
    assert [t.device.type for t in back] == ["cpu"] * len(back)
    assert x.to("cuda") is x and x.to("cuda", copy=True) is not x
    with torch.device("cuda"):
        assert torch.zeros(2).is_cuda


def test_a_copy_shares_nothing_with_the_tensor_it_is_of(counts):
    array = np.zeros(2, np.float32)
    there, shared = torch.from_numpy(array).to("cuda"), torch.as_tensor(array, device="cuda")
    back = there.cpu()
    there += 1
    array += 5
    assert (there.tolist(), shared.tolist(), back.tolist()) == ([1, 1], [0, 0], [0, 0])


@pytest.mark.parametrize(("work", "expected"), [
    (lambda x: x + 1, (1, 0, 0, 0)),
    (lambda x: x.view(-1)[1:].unsqueeze(0).transpose(0, 1).detach().split(1)[0].unbind(0), (0, 0, 0, 0)),
    (lambda x: (torch.empty_like(x), torch.empty(3, device="cuda")), (0, 0, 0, 0)),
    (lambda x: torch.zeros(3, device="cuda"), (1, 0, 0, 0)),
    (lambda x: nn.functional.linear(x, x, x[0]), (1, 0, 0, 0)),
    (lambda x: torch._foreach_add_([x, x.clone(), x.clone()], 1.0), (3, 0, 0, 0)),
    (lambda x: x.sum().item(), (1, 1, 0, 0)),
    (lambda x: float(x[0, 0]), (0, 1, 0, 0)),
    (lambda x: int(x[0, 0]), (0, 1, 0, 0)),
    (lambda x: bool(x[0, 0]), (0, 1, 0, 0)),
    (lambda x: f"{x[0, 0]:.3f}", (0, 1, 0, 0)),
    (lambda x: 1 if (x > 0).all() else 0, (2, 1, 0, 0)),
    (lambda x: x[0].tolist(), (0, 1, 0, 1)),
    (lambda x: repr(x), (0, 1, 0, 1)),
    (lambda x: x.nonzero(), (1, 1, 0, 0)),
    (lambda x: x[x > 0], (2, 1, 0, 0)),
    (lambda x: x.__setitem__(x > 0, 2.0), (2, 0, 0, 0)),
    (lambda x: x.__setitem__(x > 0, x.sum()), (3, 1, 0, 0)),
    (lambda x: x.masked_fill_(x > 0, 2.0), (2, 0, 0, 0)),
    (lambda x: x.masked_select(x > 0), (2, 1, 0, 0)),
    (lambda x: torch.equal(x, x), (1, 1, 0, 0)),
    (lambda x: x.cpu(), (0, 1, 0, 1)),
    (lambda x: x.to("cpu", torch.float64), (1, 1, 0, 1)),
    (lambda x: torch.ones(3).to("cuda", torch.float64), (0, 0, 1, 0)),
    (lambda x: torch.tensor([1.0], device="cuda"), (0, 0, 1, 0)),
    (lambda x: x.copy_(torch.ones(3)), (0, 0, 1, 0)),
    (lambda x: torch.ones(3, 3).copy_(x), (0, 1, 0, 1)),
    (lambda x: torch.ones(3, 3) + 1, (0, 0, 0, 0)),
    (lambda x: torch.cuda.synchronize(), (0, 1, 0, 0)),
])
@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
def test_costs(counts, work, expected, mode):
    with mode():
        x = on_device(3, 3)
        counts.reset()
        work(x)
    assert cost(counts) == expected


def test_counts_are_kept_by_kind_by_source_line_and_in_bytes(counts):
    def twice(x):
        return (x * 2) * 2

    x = torch.ones(4).to("cuda")
    for _ in range(3):
        x = twice(x)
    x.sum().item()
    line = twice.__code__.co_firstlineno + 1
    where = "tests/unit/core/test_pretended_device.py"
    assert counts.by_line(KERNELS).most_common() == [(f"{where}:{line}", 6), (f"{where}:{line + 5}", 1)]
    assert counts.by_kind(KERNELS) == {"aten.mul.Tensor": 6, "aten.sum.default": 1}
    assert counts.by_kind(WAITS).total() == 1 and counts.by_kind(UP).total() == 1 and not counts.by_kind(DOWN)
    assert (counts.bytes_up, counts.bytes_down) == (16, 0)
    x.cpu()
    assert counts.bytes_down == 16 and counts.copies == 2
    assert f"kernels: 7\n       6 {where}:{line}\n" in counts.report()
    assert "copies up: 1, 16 bytes" in counts.report(most=0)
    counts.reset()
    assert counts.report() == "kernels: 0\nwaits: 0\ncopies up: 0\ncopies down: 0"


class Doubled(torch.autograd.Function):
    """Makes a tensor of its own in the backward pass, where the gradient is."""

    @staticmethod
    def forward(ctx, x):
        return 2 * x

    @staticmethod
    def backward(ctx, gradient):
        return gradient * torch.full(gradient.shape, 2.0, device=gradient.device)


class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.first, self.norm, self.last = nn.Linear(8, 16), nn.LayerNorm(16), nn.Linear(16, 4)
        self.register_buffer("shift", torch.linspace(-1, 1, 16))

    def forward(self, x):
        used, _unused = self.last(nn.functional.gelu(self.norm(self.first(x)) + self.shift)).split(2, dim=-1)
        return Doubled.apply(used)


OPTIMISERS = {
    "fused AdamW": lambda p: torch.optim.AdamW(p, lr=0.01, fused=True),
    "Adam": lambda p: torch.optim.Adam(p, lr=0.01),
    "SGD": lambda p: torch.optim.SGD(p, lr=0.01, momentum=0.9),
}


def train(device, optimiser):
    """Return all weights, the average, and a gradient that went through a copy, after a few steps of everything."""
    torch.manual_seed(0)
    net = Net().to(device)
    average = copy.deepcopy(net)
    optimiser, generator = optimiser(net.parameters()), torch.Generator().manual_seed(1)
    beginning = torch.zeros(8, requires_grad=True)
    for step in range(4):
        x = torch.randn(5, 8, generator=generator).to(device) + beginning.to(device)
        with torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=step % 2 == 0):
            loss = checkpoint(net, x, use_reentrant=False).float().square().mean()
        with torch.inference_mode():
            loss_of_average = average(x).float().mean()
        (loss + loss_of_average.clone()).backward()
        nn.utils.clip_grad_norm_(net.parameters(), 0.1)
        optimiser.step()
        optimiser.zero_grad()
        with torch.no_grad():
            torch._foreach_lerp_(list(average.parameters()), list(net.parameters()), 0.1)
    return [t.detach().cpu() for t in (*net.state_dict().values(), *average.parameters(), beginning.grad)]


@pytest.mark.parametrize("name", OPTIMISERS)
def test_a_training_loop_has_the_bits_of_the_cpu(name):
    outside = train("cpu", OPTIMISERS[name])
    with pretended_cuda() as counts:
        inside = train("cuda", OPTIMISERS[name])
    assert counts.copies_down == 4 + len(inside) - 1 and counts.waits == counts.copies_down
    assert all(map(torch.equal, inside, outside))


def test_optimisers_and_clipping_take_the_kernels_they_take_on_cuda(counts):
    net = Net().to("cuda")
    fused, plain = torch.optim.AdamW(net.parameters(), fused=True), torch.optim.Adam(net.parameters())
    net(on_device(5, 8)).sum().backward()
    counts.reset()
    fused.step()
    assert counts.by_kind(KERNELS)["aten._fused_adamw_.default"] == 1 and counts.waits == 0
    plain.step()
    counts.reset()
    plain.step()
    nn.utils.clip_grad_norm_(net.parameters(), 1.0)
    assert {kind for kind in counts.by_kind(KERNELS) if "foreach" not in kind} == {
        "aten.stack.default", "aten.linalg_vector_norm.default", "aten.add.Tensor", "aten.reciprocal.default",
        "aten.mul.Tensor", "aten.clamp.default",
    }
    assert counts.copies == counts.waits == 0


def test_a_forgotten_move_of_a_model_or_its_data_is_refused(counts):
    with pytest.raises(RuntimeError, match="on the same device"):
        Net()(on_device(5, 8))
    net = Net().to("cuda")
    net.shift = torch.linspace(-1, 1, 16)
    with pytest.raises(RuntimeError, match="on the same device"):
        net(on_device(5, 8))


def test_weights_go_to_files_and_back(counts, tmp_path: Path):
    net, path = Net().to("cuda"), tmp_path / "net.safetensors"
    counts.reset()
    save_file({name: value.cpu() for name, value in net.state_dict().items()}, path)
    assert counts.copies_down == len(net.state_dict()) == 7
    other = Net().to("cuda")
    counts.reset()
    other.load_state_dict(load_file(path))
    assert counts.copies_up == 7
    assert all(value.is_cuda for value in other.state_dict().values())
    assert torch.equal(other(on_device(2, 8)), net(on_device(2, 8)))
    assert not any(value.is_cuda for value in net.to("cpu").state_dict().values())


def test_memory_that_was_freed_is_not_taken_for_the_devices(counts):
    for size in range(3000):
        assert not torch.empty(1 + size % 7).is_cuda
        assert torch.empty(1 + size % 7, device="cuda").is_cuda


def test_the_fixture_gives_a_device(device):
    x = on_device(3)
    assert compute_device(device.name) == x.device == CUDA and x.sum().item() == 3
    assert device.counts is None or cost(device.counts) == (2, 1, 0, 0)
