# SPDX-License-Identifier: MIT
"""`Agent.update`, a step of Algorithm 1: against NumPy in float64, and against the
identities between the three scripts."""

import numpy as np
import pytest
import torch
from conftest import SCRIPTS, networks, td3_bc, wbc, wpc, wpc_with

STATE_DIM, ACTION_DIM, MAX_ACTION, BATCH = 5, 3, 1.5, 64

# Nothing at its default, and the noise clipped about half the time.
OPTIONS = {
    "discount": 0.9,
    "tau": 0.1,
    "policy_noise": 0.3,
    "noise_clip": 0.25,
    "actor_lr": 1e-3,
    "critic_lr": 1e-4,
}
OTHERS = {weight: wpc_with(weight) for weight in ("exponential", "random", "static")}
CASES = [("td3_bc", {"alpha": 1.7}), ("wbc", {"value_lr": 2e-4})]
CASES += [(name, {"alpha": 1.7, "value_lr": 2e-4}) for name in ("wpc", *OTHERS)]


def make_agent(script, **options):
    """An agent in float64. Its targets differ from its networks, its Q is below zero,
    where mean |Q| is not mean Q, and its target policy is at the edge, where noise
    leads over it."""
    torch.manual_seed(3)
    args = script.Args(device="cpu", **options)
    agent = script.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, args)
    for network in networks(agent).values():
        network.double()
    with torch.no_grad():
        for target in (agent.actor_target, agent.critic_target):
            for parameter in target.parameters():
                parameter += 0.05 * torch.randn_like(parameter)
        agent.actor_target[4].weight *= 30
        agent.critic.q1[4].bias -= 0.5
        agent.critic.q2[4].bias -= 0.5
    return agent


def make_batch():
    torch.manual_seed(4)
    flags = (torch.rand(2, BATCH, 1) < 0.4).double()
    return {
        "observations": torch.randn(BATCH, STATE_DIM, dtype=torch.float64),
        "actions": MAX_ACTION * (2 * torch.rand(BATCH, ACTION_DIM).double() - 1),
        "rewards": torch.randn(BATCH, 1, dtype=torch.float64),
        "next_observations": torch.randn(BATCH, STATE_DIM, dtype=torch.float64),
        "terminals": flags[0],
        "better_half": flags[1],
    }


def center_value(agent, batch):
    """Moves V into the midst of Q, so that about half of the weights are 1."""
    s, a = batch["observations"], batch["actions"]
    with torch.no_grad():
        agent.value[4].bias += (agent.critic.q1(s, a) - agent.value(s)).median()


# The same step in NumPy, where a network is a list: weight, bias, weight, bias, ...


def numpy_networks(agent):
    return {name: numpy_parameters(net) for name, net in networks(agent).items()}


def numpy_parameters(network):
    return [parameter.detach().numpy().copy() for parameter in network.parameters()]


def mlp(p, x):
    for i in (0, 2):
        x = np.maximum(x @ p[i].T + p[i + 1], 0)
    return x @ p[4].T + p[5]


def policy(p, s):
    return MAX_ACTION * np.tanh(mlp(p, s))


def q_values(p, s, a):
    sa = np.concatenate([s, a], axis=1)
    return mlp(p[:6], sa), mlp(p[6:], sa)


def target(nets, batch, args, noise):
    """y of Algorithm 1, from standard normal noise."""
    noise = np.clip(args.policy_noise * noise, -args.noise_clip, args.noise_clip)
    s_next = batch["next_observations"]
    a_next = policy(nets["actor_target"], s_next) + MAX_ACTION * noise
    a_next = np.clip(a_next, -MAX_ACTION, MAX_ACTION)
    q_next = np.minimum(*q_values(nets["critic_target"], s_next, a_next))
    return batch["rewards"] + args.discount * (1 - batch["terminals"]) * q_next


def critic_loss(nets, batch, y):
    q1, q2 = q_values(nets["critic"], batch["observations"], batch["actions"])
    return ((q1 - y) ** 2).mean() + ((q2 - y) ** 2).mean()


def value_loss(nets, batch, y):
    return ((mlp(nets["value"], batch["observations"]) - y) ** 2).mean()


def advantage(nets, batch):
    s, a = batch["observations"], batch["actions"]
    return q_values(nets["critic"], s, a)[0] - mlp(nets["value"], s)


def weight(name, advantage, batch, permutation):
    """Equations 7 and 8, wPC-rnd and the static weight."""
    binary = (advantage > 0).astype(float)
    others = {
        "exponential": np.exp(advantage),
        "random": binary[permutation],
        "static": batch["better_half"],
    }
    return others.get(name, binary)


def lmbda(nets, batch, alpha):
    s = batch["observations"]
    q = q_values(nets["critic"], s, policy(nets["actor"], s))[0]
    return alpha / np.abs(q).mean()


def actor_loss(nets, batch, weight, lmbda):
    """The negative of equation 6; lambda is a constant to the gradient."""
    s, a = batch["observations"], batch["actions"]
    pi = policy(nets["actor"], s)
    q = q_values(nets["critic"], s, pi)[0]
    return -lmbda * q.mean() + (weight * (pi - a) ** 2).mean()


def assert_gradient(loss, parameters, network):
    """Gradients are central differences of the loss, at the steepest and at three more
    entries of each parameter."""
    for parameter, tensor in zip(parameters, network.parameters(), strict=True):
        flat, gradient = parameter.reshape(-1), tensor.grad.numpy().reshape(-1)
        entries = np.random.default_rng(0).integers(len(flat), size=3)
        for i in {int(np.abs(gradient).argmax()), *entries.tolist()}:
            original = flat[i]
            flat[i] = original + 1e-6
            above = loss()
            flat[i] = original - 1e-6
            below = loss()
            flat[i] = original
            slope = (above - below) / 2e-6
            assert slope == pytest.approx(gradient[i], rel=1e-4, abs=1e-7)


def assert_adam_step(before, after, network, learning_rate):
    """Adam's first step is lr * sign(gradient)."""
    for old, new, tensor in zip(before, after, network.parameters(), strict=True):
        gradient = tensor.grad.numpy()
        sure = np.abs(gradient) > 1e-5
        expected = -learning_rate * np.sign(gradient)[sure]
        np.testing.assert_allclose((new - old)[sure], expected, rtol=1e-2)


def assert_critics_and_value_agree(agent, batch, step):
    """Does a step and compares what it does to critics and value with NumPy.

    Returns the networks before the step and after it, and its metrics.
    """
    before, arrays = numpy_networks(agent), {k: x.numpy() for k, x in batch.items()}
    torch.manual_seed(step)
    noise = torch.randn(BATCH, ACTION_DIM, dtype=torch.float64).numpy()
    torch.manual_seed(step)
    metrics = {key: x.item() for key, x in agent.update(batch, step).items()}
    after = numpy_networks(agent)

    y = target(before, arrays, agent.args, noise)
    q1, _ = q_values(before["critic"], arrays["observations"], arrays["actions"])
    expected = {"q": q1.mean(), "critic_loss": critic_loss(before, arrays, y)}
    if "value" in before:
        expected["v"] = mlp(before["value"], arrays["observations"]).mean()
        expected["value_loss"] = value_loss(before, arrays, y)
    assert metrics | expected == pytest.approx(metrics, rel=1e-6)
    if step % 2:  # else the policy's step has left its gradients in the critics
        loss = lambda: critic_loss(before, arrays, y)  # noqa: E731
        assert_gradient(loss, before["critic"], agent.critic)
    if "value" in before:
        loss = lambda: value_loss(before, arrays, y)  # noqa: E731
        assert_gradient(loss, before["value"], agent.value)
    return before, after, metrics


@pytest.mark.parametrize("name, options", CASES)
def test_three_steps_agree_with_numpy(name, options):
    agent = make_agent((SCRIPTS | OTHERS)[name], **OPTIONS, **options)
    batch, has_value = make_batch(), name != "td3_bc"
    arrays = {k: x.numpy() for k, x in batch.items()}
    if has_value:
        center_value(agent, batch)

    before, after, _ = assert_critics_and_value_agree(agent, batch, step=1)
    assert_adam_step(before["critic"], after["critic"], agent.critic, 1e-4)
    if has_value:
        assert_adam_step(before["value"], after["value"], agent.value, 2e-4)

    # the policy, from critics and value after the step
    before, after, metrics = assert_critics_and_value_agree(agent, batch, step=2)
    nets = after | {"actor": before["actor"]}
    expected, w = {}, np.ones((BATCH, 1))
    if has_value:
        old, new = advantage(before, arrays), advantage(after, arrays)
        assert 0.2 < (new > 0).mean() < 0.8  # these cases can tell one weight from
        assert ((old > 0) != (new > 0)).any()  # another, and old networks from new
        torch.manual_seed(2)
        torch.randn(BATCH, ACTION_DIM, dtype=torch.float64)  # the target's noise
        permutation = torch.randperm(BATCH).numpy()
        w = weight(name, new, arrays, permutation)
        expected["weight"] = w.mean()
    lam = 0.0
    if "alpha" in options:
        lam = expected["lmbda"] = lmbda(nets, arrays, options["alpha"])
    expected["actor_loss"] = actor_loss(nets, arrays, w, lam)
    loss = lambda: actor_loss(nets, arrays, w, lam)  # noqa: E731
    assert_gradient(loss, nets["actor"], agent.actor)
    assert_adam_step(before["actor"], after["actor"], agent.actor, 1e-3)
    for key in ("q", "critic_loss", "v", "value_loss"):
        metrics.pop(key, None)
    assert metrics == pytest.approx(expected, rel=1e-6)

    for network in ("actor", "critic"):
        pairs = zip(before[f"{network}_target"], after[network], strict=True)
        moved = [0.9 * old + 0.1 * new for old, new in pairs]
        for parameter, there in zip(after[f"{network}_target"], moved, strict=True):
            np.testing.assert_allclose(parameter, there, 1e-12, 1e-12)

    # the next step has forgotten the gradients of this one
    assert_critics_and_value_agree(agent, batch, step=3)


STEPS = [(2, 1, False), (2, 2, True), (3, 2, False), (3, 3, True), (1, 1, True)]


@pytest.mark.parametrize("policy_freq, step, moves", STEPS)
def test_policy_and_targets_move_every_policy_freq_steps(
    script, policy_freq, step, moves
):
    agent = make_agent(script, policy_freq=policy_freq)
    agent.args.alpha, batch = 2.5, make_batch()
    if hasattr(agent, "value"):
        center_value(agent, batch)
    before = numpy_networks(agent)
    metrics = agent.update(batch, step)
    assert ("actor_loss" in metrics) == moves
    for name, parameters in numpy_networks(agent).items():
        pairs = zip(before[name], parameters, strict=True)
        changed = any((old != new).any() for old, new in pairs)
        assert changed == (moves or name in ("critic", "value")), name


def test_networks_are_table_4s_and_start_alike():
    agents = {}
    for name, script in SCRIPTS.items():
        torch.manual_seed(5)
        args = script.Args(device="cpu")
        agents[name] = script.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, args)
    ours = networks(agents["wpc"])
    shapes = [tuple(p.shape) for p in ours["value"].parameters()]
    hidden = [(256, STATE_DIM), (256,), (256, 256), (256,)]
    assert shapes == [*hidden, (1, 256), (1,)]
    for name in ("td3_bc", "wbc"):
        for key, network in networks(agents[name]).items():
            assert_same_network(network, ours[key])
    far = agents["wpc"].actor(1e6 * torch.ones(1, STATE_DIM))
    assert far.abs().max() == MAX_ACTION


def assert_same_network(one, other):
    for p, q in zip(one.parameters(), other.parameters(), strict=True):
        assert torch.equal(p, q)


def twenty_steps(script, better_half=None, **options):
    """An agent after 20 steps in float32, the last column filled with `better_half`."""
    torch.manual_seed(1)
    args = script.Args(device="cpu", **options)
    agent = script.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, args)
    dataset = {key: x.float() for key, x in make_batch().items()}
    if better_half is not None:
        dataset["better_half"] = torch.full((BATCH, 1), better_half)
    torch.manual_seed(1)
    for step in range(1, 21):
        agent.update(script.sample_batch(dataset, 32), step)
    return networks(agent)


def assert_same(one, other):
    """Both agents agree to the last bit in the networks that they share."""
    shared = one.keys() & other.keys()
    assert shared >= {"actor", "actor_target", "critic", "critic_target"}
    for name in shared:
        assert_same_network(one[name], other[name])


def test_wpc_with_weight_one_is_td3_bc():
    ours = twenty_steps(OTHERS["static"], better_half=1.0, alpha=2.5)
    assert_same(ours, twenty_steps(td3_bc, alpha=2.5))


def test_wpc_without_the_q_term_is_wbc():
    assert_same(twenty_steps(wpc, alpha=0.0), twenty_steps(wbc))


def test_td3_bc_without_the_q_term_is_behaviour_cloning():
    torch.manual_seed(1)
    args = td3_bc.Args(device="cpu")
    actor = td3_bc.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, args).actor
    optimizer = td3_bc.Adam(actor.parameters(), 3e-4)
    dataset = {key: x.float() for key, x in make_batch().items()}
    torch.manual_seed(1)
    for step in range(1, 21):
        batch = td3_bc.sample_batch(dataset, 32)
        torch.randn(32, ACTION_DIM)  # the target's noise
        if step % 2 == 0:
            pi = actor(batch["observations"])
            optimizer.zero_grad()
            ((pi - batch["actions"]) ** 2).mean().backward()
            optimizer.step()
    assert_same_network(actor, twenty_steps(td3_bc, alpha=0.0)["actor"])


@pytest.mark.parametrize("script", [wpc, wbc])
def test_an_action_that_is_as_good_as_average_has_weight_zero(script):
    agent = make_agent(script, critic_lr=0.0, value_lr=0.0)
    for network in (agent.critic, agent.value):
        for parameter in network.parameters():
            parameter.data.zero_()
    assert agent.update(make_batch(), step=2)["weight"] == 0  # as Q = V = 0


def test_exponential_weight_is_cut_off_at_100():
    agent = make_agent(OTHERS["exponential"], critic_lr=0.0, value_lr=0.0)
    agent.value[4].bias.data -= 1e4
    assert agent.update(make_batch(), step=2)["weight"] == 100


def test_random_weight_is_a_new_permutation_each_time():
    """Drawn anew, the weights fall on other actions, so the policy's loss differs."""
    agent, batch = make_agent(OTHERS["random"], actor_lr=0.0), make_batch()
    agent.critic_optimizer.param_groups[0]["lr"] = 0.0
    agent.value_optimizer.param_groups[0]["lr"] = 0.0
    center_value(agent, batch)
    all_metrics = [agent.update(batch, step=2) for _ in range(8)]
    losses = {metrics["actor_loss"].item() for metrics in all_metrics}
    means = {metrics["weight"].item() for metrics in all_metrics}
    assert len(losses) == 8 and len(means) == 1


def test_columns_of_one_axis_are_not_broadcast(script):
    """Rewards (B,) would make targets (B, B)."""
    args = script.Args(device="cpu")
    for name in ("rewards", "terminals"):
        batch = {key: torch.ones(4, 3) for key in ("observations", "next_observations")}
        batch |= {"actions": torch.ones(4, 1), "rewards": torch.ones(4, 1)}
        batch |= {"terminals": torch.zeros(4, 1)}
        batch[name] = batch[name][:, 0]
        with pytest.raises(AssertionError, match=r"must be \(B, 1\)"):
            script.Agent(3, 1, 1.0, args).update(batch, 2)
