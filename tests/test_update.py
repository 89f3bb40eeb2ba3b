# SPDX-License-Identifier: MIT
"""`update`, Algorithm 1's step, against NumPy in float64, and against the identities between the three scripts."""

import copy

import numpy as np
import pytest
import torch
from conftest import SCRIPTS, td3_bc, wbc, wpc

OBS, ACT, BATCH = 5, 3, 64
# nothing at its default, the noise clipped about half the time
OPTIONS = dict(discount=0.9, tau=0.1, policy_noise=0.3, noise_clip=0.25, policy_lr=1e-3, q_lr=1e-4, seed=3)
CASES = [("td3_bc", {"alpha": 1.7}), ("wbc", {"v_lr": 2e-4})]
CASES += [("wpc", {"alpha": 1.7, "v_lr": 2e-4, "weight": w, "beta": 0.02}) for w in ("binary", "exponential", "random", "static")]


def make(name, options):
    """A script's arguments, float64 networks, optimizers and a batch, with Q below zero and V in its midst."""
    script = SCRIPTS[name]
    args = script.Args(**OPTIONS | options)
    networks, optimizers = script.make_networks(OBS, ACT, args, "cpu")
    for network in networks.values():
        network.double()
    with torch.no_grad():  # targets unlike the networks; Q < 0, where mean |Q| is not mean Q
        rng = torch.Generator().manual_seed(1)
        for name in ("actor_target", "critic_target"):
            for p in networks[name].parameters():
                p.add_(0.05 * torch.randn(p.shape, generator=rng))
        networks["actor_target"][4].weight *= 30  # saturated: noise leads beyond the largest action
        for q in networks["critic"]:
            q[4].bias -= 0.5
    rng = torch.Generator().manual_seed(2)
    s, s_next = (torch.randn(BATCH, OBS, generator=rng).double() for _ in range(2))
    a = torch.rand(BATCH, ACT, generator=rng).double() * 2 - 1
    r = torch.randn(BATCH, 1, generator=rng).double()
    not_done, half = (torch.rand(2, BATCH, 1, generator=rng) < 0.6).double()
    if "value" in networks:
        with torch.no_grad():
            networks["value"][4].bias += (networks["critic"][0](torch.cat([s, a], 1)) - networks["value"](s)).median()
    return script, args, networks, optimizers, (s, a, r, not_done, s_next, half)[: 6 if script is wpc else 5]


def arrays(networks):
    """Each network as a list of NumPy arrays: weight, bias, weight, bias, ..."""
    return {name: [p.detach().numpy().copy() for p in n.parameters()] for name, n in networks.items()}


def mlp(p, x):
    for i in (0, 2):
        x = np.maximum(x @ p[i].T + p[i + 1], 0)
    return x @ p[4].T + p[5]


def q_values(p, s, a):
    x = np.concatenate([s, a], 1)
    return mlp(p[:6], x), mlp(p[6:], x)


def critic_losses(p, batch, args, noise):
    """y, Q1, V and both losses, as in Algorithm 1, from the parameters before the step."""
    s, a, r, not_done, s_next = batch[:5]
    noise = np.clip(args.policy_noise * noise, -args.noise_clip, args.noise_clip)
    a_next = np.clip(np.tanh(mlp(p["actor_target"], s_next)) + noise, -1, 1)
    y = r + args.discount * not_done * np.minimum(*q_values(p["critic_target"], s_next, a_next))
    q1, q2 = q_values(p["critic"], s, a)
    values = {"target_q": y.mean(), "q": q1.mean(), "critic_loss": ((q1 - y) ** 2).mean() + ((q2 - y) ** 2).mean()}
    if "value" in p:
        v = mlp(p["value"], s)
        values |= {"v": v.mean(), "v_loss": ((v - y) ** 2).mean()}
    return values


def actor_losses(p, batch, args, weight, lmbda=None):
    """lambda and the actor's loss, with a given weight; lambda is a constant to the gradient."""
    s, a = batch[:2]
    pi = np.tanh(mlp(p["actor"], s))
    values = {"action_distance": np.abs(pi - a).mean(), "actor_loss": (weight * (pi - a) ** 2).mean()}
    if hasattr(args, "alpha"):
        q = q_values(p["critic"], s, pi)[0]
        values["lmbda"] = args.alpha / np.abs(q).mean() if lmbda is None else lmbda
        values["actor_loss"] -= values["lmbda"] * q.mean()
    return values


def assert_gradient(loss, parameters, gradients):
    """Central differences at some entries of every parameter, the steepest among them."""
    for parameter, gradient in zip(parameters, gradients):
        flat, g = parameter.reshape(-1), gradient.numpy().reshape(-1)
        for i in {int(np.abs(g).argmax()), *np.random.default_rng(0).integers(len(flat), size=3).tolist()}:
            values, original = [], flat[i]
            for step in (1e-6, -1e-6):
                flat[i] = original + step
                values.append(loss())
            flat[i] = original
            assert (values[0] - values[1]) / 2e-6 == pytest.approx(g[i], rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("name, options", CASES)
def test_update_agrees_with_numpy(name, options):
    script, args, networks, optimizers, batch = make(name, options)
    before, rng = arrays(networks), torch.Generator().manual_seed(7)
    noise = torch.randn(BATCH, ACT, generator=torch.Generator().manual_seed(7)).double().numpy()
    np_batch = [x.numpy() for x in batch]
    metrics = {k: v.item() for k, v in script.update(networks, optimizers, batch, args, 2, rng).items()}
    after = arrays(networks)

    expected = critic_losses(before, np_batch, args, noise)
    learning = {"critic": "critic_loss", "value": "v_loss"} if name != "td3_bc" else {"critic": "critic_loss"}
    for network, loss in learning.items():
        gradients = [p.grad for p in networks[network].parameters()]
        assert_gradient(lambda: critic_losses(before, np_batch, args, noise)[loss], before[network], gradients)

    # the policy's part, with critics and V as this step left them and the actor as it was
    mixed = after | {"actor": before["actor"]}
    weight = np.ones((BATCH, 1))
    if name != "td3_bc":
        advantage = q_values(after["critic"], *np_batch[:2])[0] - mlp(after["value"], np_batch[0])
        weight = (advantage > 0).astype(float)
        assert 0.2 < weight.mean() < 0.8  # a case that can tell
        lagging = q_values(before["critic"], *np_batch[:2])[0] - mlp(before["value"], np_batch[0])
        assert ((lagging > 0) != (advantage > 0)).any()  # so can the networks' age
        shuffled = torch.Generator().manual_seed(7)
        torch.randn(BATCH, ACT, generator=shuffled)
        order = torch.rand(BATCH, generator=shuffled).argsort().numpy()
        weight = {
            "binary": weight,
            "exponential": np.minimum(np.exp(advantage / 0.02), 100),
            "random": weight[order],
            "static": np_batch[-1],
        }[options.get("weight", "binary")]
        expected["weight"] = (weight > 0).mean()
    expected |= actor_losses(mixed, np_batch, args, weight)
    assert metrics == pytest.approx(expected, rel=1e-6)
    gradients = [p.grad for p in networks["actor"].parameters()]
    loss = lambda: actor_losses(mixed, np_batch, args, weight, expected.get("lmbda"))["actor_loss"]  # noqa: E731
    assert_gradient(loss, mixed["actor"], gradients)

    rates = {"actor": args.policy_lr, "critic": args.q_lr, "value": getattr(args, "v_lr", None)}
    for network in ("actor", *learning):  # Adam's first step is lr * sign(gradient)
        for old, new, p in zip(before[network], after[network], networks[network].parameters()):
            sure = np.abs(p.grad.numpy()) > 1e-5
            assert (new - old)[sure] == pytest.approx(-rates[network] * np.sign(p.grad.numpy())[sure], rel=1e-2)
    for network in ("actor", "critic"):
        for old, target, new in zip(before[f"{network}_target"], after[f"{network}_target"], after[network]):
            assert target == pytest.approx((1 - args.tau) * old + args.tau * new, rel=1e-12)


@pytest.mark.parametrize("policy_freq, step, moves", [(2, 1, False), (2, 2, True), (3, 2, False), (3, 3, True), (1, 1, True)])
def test_policy_and_targets_move_every_policy_freq_steps(script, policy_freq, step, moves):
    _, args, networks, optimizers, batch = make(script.SCRIPT, {"policy_freq": policy_freq})
    args.alpha = 2.5
    before = arrays(networks)
    metrics = script.update(networks, optimizers, batch, args, step, torch.Generator())
    assert ("actor_loss" in metrics) == moves
    for name, parameters in arrays(networks).items():
        changed = any((old != new).any() for old, new in zip(before[name], parameters))
        assert changed == (moves or name in ("critic", "value")), name


def test_networks_are_table_4s_and_start_alike():
    networks = {n: s.make_networks(OBS, ACT, s.Args(seed=5), "cpu")[0] for n, s in SCRIPTS.items()}
    shapes = [tuple(p.shape) for p in networks["wpc"]["value"].parameters()]
    assert shapes == [(256, OBS), (256,), (256, 256), (256,), (1, 256), (1,)]
    for other in ("td3_bc", "wbc"):
        for name, network in networks[other].items():
            for p, q in zip(network.parameters(), networks["wpc"][name].parameters(), strict=True):
                assert torch.equal(p, q)
    actor, other_seed = networks["wpc"]["actor"], wpc.make_networks(OBS, ACT, wpc.Args(seed=6), "cpu")[0]["actor"]
    assert not torch.equal(actor[0].weight, other_seed[0].weight)
    assert actor(1e6 * torch.ones(1, OBS)).abs().max() == 1


def twenty_steps(script, options, forced=None):
    """Networks after 20 steps on float32 batches sampled as in `train`; `forced` is put into the last column."""
    args = script.Args(seed=1, **options)
    networks, optimizers = script.make_networks(OBS, ACT, args, "cpu")
    data, rng = torch.randn(500, 2 * OBS + ACT + 3, generator=torch.Generator().manual_seed(0)), torch.Generator().manual_seed(1)
    for step in range(1, 21):
        rows = data[torch.randint(len(data), (256,), generator=rng)]
        batch = list(rows.split([OBS, ACT, 1, 1, OBS, 1], 1))
        batch[-1] = torch.full((256, 1), forced) if forced is not None else batch[-1]
        script.update(networks, optimizers, batch[: 6 if script is wpc else 5], args, step, rng)
    return arrays(networks)


def assert_same(one, other, names):
    for name in names:
        assert all(np.array_equal(p, q) for p, q in zip(one[name], other[name], strict=True)), name


ALL = ("actor", "critic", "actor_target", "critic_target")


def test_wpc_with_weight_one_is_td3_bc():
    assert_same(twenty_steps(wpc, {"alpha": 2.5, "weight": "static"}, 1.0), twenty_steps(td3_bc, {"alpha": 2.5}), ALL)


def test_wpc_without_the_q_term_is_wbc():
    assert_same(twenty_steps(wpc, {"alpha": 0.0}), twenty_steps(wbc, {}), (*ALL, "value"))


def test_td3_bc_with_alpha_zero_is_behaviour_cloning():
    args = td3_bc.Args(seed=1)
    actor = td3_bc.make_networks(OBS, ACT, args, "cpu")[0]["actor"]
    optimizer = torch.optim.Adam(actor.parameters(), 3e-4, fused=True)
    data, rng = torch.randn(500, 2 * OBS + ACT + 3, generator=torch.Generator().manual_seed(0)), torch.Generator().manual_seed(1)
    for step in range(1, 21):
        rows = data[torch.randint(len(data), (256,), generator=rng)]
        torch.randn(256, ACT, generator=rng)
        if step % 2 == 0:
            optimizer.zero_grad()
            ((actor(rows[:, :OBS]) - rows[:, OBS : OBS + ACT]) ** 2).mean().backward()
            optimizer.step()
    assert_same(twenty_steps(td3_bc, {"alpha": 0.0}), arrays({"actor": actor}), ["actor"])


def weights(kind, advantage, seed=0, **options):
    """wpc's weights for given advantages, read off the actor's gradient-free loss: one row a batch entry."""
    args = wpc.Args(alpha=0.0, weight=kind, policy_lr=0.0, q_lr=0.0, v_lr=0.0, **options)
    networks, optimizers = wpc.make_networks(1, 1, args, "cpu")
    with torch.no_grad():
        for network in (*networks["critic"], networks["value"], networks["actor"]):
            for p in network.parameters():
                p.zero_()
        q1 = networks["critic"][0]  # Q1(s, a) = relu(s) - relu(-s) = s, V = 0, pi = 0
        q1[0].weight[:2, 0], q1[2].weight[0, 0], q1[2].weight[1, 1] = torch.tensor([1.0, -1.0]), 1, 1
        q1[4].weight[0, :2] = torch.tensor([1.0, -1.0])
    result, rng = [], torch.Generator().manual_seed(seed)
    state = rng.get_state()
    s = torch.as_tensor(advantage, dtype=torch.float32)[:, None]
    for i in range(len(s)):  # only entry i has an action to imitate: the loss is its weight / batch
        a = torch.zeros(len(s), 1)
        a[i] = 1
        rng.set_state(state)
        batch = (s, a, 0 * a, 0 * a, s, 0 * a)
        result.append(wpc.update(networks, copy.deepcopy(optimizers), batch, args, 2, rng)["actor_loss"].item() * len(s))
    return np.array(result)


ADVANTAGE = np.array([-1e4, -2.0, -1e-3, 0.0, 1e-3, 0.5, 3.0, 1e4])


def test_binary_weight():
    assert weights("binary", ADVANTAGE).tolist() == [0, 0, 0, 0, 1, 1, 1, 1]  # strictly better: eq. 7


@pytest.mark.parametrize("beta", [1.0, 0.1, 10.0])
def test_exponential_weight_is_cut_off_and_never_overflows(beta):
    expected = np.exp(np.minimum(ADVANTAGE / beta, np.log(100)))
    assert weights("exponential", ADVANTAGE, beta=beta) == pytest.approx(expected, rel=1e-5)


def test_random_weight_is_a_new_permutation_each_time():
    draws = [weights("random", ADVANTAGE, seed) for seed in range(8)]
    assert all(sorted(draw) == [0] * 4 + [1] * 4 for draw in draws)
    assert len({tuple(draw) for draw in draws}) > 4
