# SPDX-License-Identifier: MIT
"""`Agent.update`, a step of Algorithm 1: against NumPy in float64, and against the
identities between the three scripts."""

import numpy as np
import pytest
import torch
from conftest import SCRIPTS, td3_bc, wbc, wpc

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
WEIGHTS = ["binary", "exponential", "random", "static"]
CASES = [("td3_bc", {"alpha": 1.7}), ("wbc", {"value_lr": 2e-4})]
for kind in WEIGHTS:
    options = {"alpha": 1.7, "value_lr": 2e-4, "weight": kind, "beta": 0.02}
    CASES.append(("wpc", options))


def make_agent(script, **options):
    """An agent in float64. Its targets differ from its networks, its Q is below zero,
    where mean |Q| is not mean Q, and its target policy is at the edge, where noise
    leads over it."""
    torch.manual_seed(3)
    args = script.Args(**options)
    agent = script.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, args).double()
    with torch.no_grad():
        for target in (agent.actor_target, agent.critic_target):
            for parameter in target.parameters():
                parameter += 0.05 * torch.randn_like(parameter)
        agent.actor_target.net[4].weight *= 30
        agent.critic.q1_net[4].bias -= 0.5
        agent.critic.q2_net[4].bias -= 0.5
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
        agent.value.net[4].bias += (agent.critic.q1(s, a) - agent.value(s)).median()


# The same step in NumPy, where a network is a list: weight, bias, weight, bias, ...


def numpy_networks(agent):
    networks = dict(agent.named_children())
    return {name: numpy_parameters(network) for name, network in networks.items()}


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


def target(networks, batch, args, noise):
    """y of Algorithm 1, from standard normal noise."""
    noise = np.clip(args.policy_noise * noise, -args.noise_clip, args.noise_clip)
    s_next = batch["next_observations"]
    a_next = policy(networks["actor_target"], s_next) + MAX_ACTION * noise
    a_next = np.clip(a_next, -MAX_ACTION, MAX_ACTION)
    q_next = np.minimum(*q_values(networks["critic_target"], s_next, a_next))
    return batch["rewards"] + args.discount * (1 - batch["terminals"]) * q_next


def critic_loss(networks, batch, y):
    q1, q2 = q_values(networks["critic"], batch["observations"], batch["actions"])
    return ((q1 - y) ** 2).mean() + ((q2 - y) ** 2).mean()


def value_loss(networks, batch, y):
    return ((mlp(networks["value"], batch["observations"]) - y) ** 2).mean()


def advantage(networks, batch):
    s, a = batch["observations"], batch["actions"]
    return q_values(networks["critic"], s, a)[0] - mlp(networks["value"], s)


def weight(kind, advantage, batch, permutation):
    """Equations 7 and 8, wPC-rnd and the static weight."""
    binary = (advantage > 0).astype(float)
    weights = {
        "binary": binary,
        "exponential": np.minimum(np.exp(advantage / 0.02), 100),
        "random": binary[permutation],
        "static": batch["better_half"],
    }
    return weights[kind]


def lmbda(networks, batch, alpha):
    s = batch["observations"]
    q = q_values(networks["critic"], s, policy(networks["actor"], s))[0]
    return alpha / np.abs(q).mean()


def actor_loss(networks, batch, weight, lmbda):
    """The negative of equation 6; lambda is a constant to the gradient."""
    s, a = batch["observations"], batch["actions"]
    pi = policy(networks["actor"], s)
    q = q_values(networks["critic"], s, pi)[0]
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
        assert (new - old)[sure] == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("name, options", CASES)
def test_a_step_agrees_with_numpy(name, options):
    agent = make_agent(SCRIPTS[name], **OPTIONS, **options)
    batch, has_value = make_batch(), name != "td3_bc"
    if has_value:
        center_value(agent, batch)
    before, arrays = numpy_networks(agent), {k: x.numpy() for k, x in batch.items()}

    torch.manual_seed(7)
    noise = torch.randn(BATCH, ACTION_DIM, dtype=torch.float64).numpy()
    permutation = torch.randperm(BATCH).numpy()
    torch.manual_seed(7)
    metrics = {key: x.item() for key, x in agent.update(batch, step=2).items()}
    after = numpy_networks(agent)

    # critics and value, from the networks before the step
    y = target(before, arrays, agent.args, noise)
    q1, _ = q_values(before["critic"], arrays["observations"], arrays["actions"])
    expected = {"q": q1.mean(), "critic_loss": critic_loss(before, arrays, y)}
    loss = lambda: critic_loss(before, arrays, y)  # noqa: E731
    assert_gradient(loss, before["critic"], agent.critic)  # nothing of the policy's
    assert_adam_step(before["critic"], after["critic"], agent.critic, 1e-4)
    if has_value:
        expected["v"] = mlp(before["value"], arrays["observations"]).mean()
        expected["value_loss"] = value_loss(before, arrays, y)
        loss = lambda: value_loss(before, arrays, y)  # noqa: E731
        assert_gradient(loss, before["value"], agent.value)
        assert_adam_step(before["value"], after["value"], agent.value, 2e-4)

    # the policy, from critics and value after the step
    networks = after | {"actor": before["actor"]}
    w = np.ones((BATCH, 1))
    if has_value:
        old, new = advantage(before, arrays), advantage(after, arrays)
        assert 0.2 < (new > 0).mean() < 0.8  # these cases can tell one weight from
        assert ((old > 0) != (new > 0)).any()  # another, and old networks from new
        w = weight(options.get("weight", "binary"), new, arrays, permutation)
        expected["weight"] = w.mean()
    lam = 0.0
    if "alpha" in options:
        lam = expected["lmbda"] = lmbda(networks, arrays, options["alpha"])
    expected["actor_loss"] = actor_loss(networks, arrays, w, lam)
    loss = lambda: actor_loss(networks, arrays, w, lam)  # noqa: E731
    assert_gradient(loss, networks["actor"], agent.actor)
    assert_adam_step(before["actor"], after["actor"], agent.actor, 1e-3)
    assert metrics == pytest.approx(expected, rel=1e-6)

    for network in ("actor", "critic"):
        pairs = zip(before[f"{network}_target"], after[network], strict=True)
        moved = [0.9 * old + 0.1 * new for old, new in pairs]
        for parameter, there in zip(after[f"{network}_target"], moved, strict=True):
            assert parameter == pytest.approx(there, rel=1e-12)


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
        args = script.Args()
        agents[name] = script.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, args)
    shapes = [tuple(p.shape) for p in agents["wpc"].value.parameters()]
    hidden = [(256, STATE_DIM), (256,), (256, 256), (256,)]
    assert shapes == [*hidden, (1, 256), (1,)]
    ours = agents["wpc"].state_dict()
    for name in ("td3_bc", "wbc"):
        for key, parameter in agents[name].state_dict().items():
            assert torch.equal(parameter, ours[key]), key
    far = agents["wpc"].actor(1e6 * torch.ones(1, STATE_DIM))
    assert far.abs().max() == MAX_ACTION


def twenty_steps(script, better_half=None, **options):
    """An agent after 20 steps in float32, the last column filled with `better_half`."""
    torch.manual_seed(1)
    agent = script.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, script.Args(**options))
    torch.manual_seed(1)
    dataset = {key: x.float() for key, x in make_batch().items()}
    if better_half is not None:
        dataset["better_half"] = torch.full((BATCH, 1), better_half)
    torch.manual_seed(1)
    for step in range(1, 21):
        agent.update(script.sample_batch(dataset, 32), step)
    return agent.state_dict()


def assert_same(one, other):
    """Both state dicts agree to the last bit where they share a network."""
    shared = one.keys() & other.keys()
    assert {key.split(".")[0] for key in shared} >= {"actor", "critic", "actor_target"}
    for key in shared:
        assert torch.equal(one[key], other[key]), key


def test_wpc_with_weight_one_is_td3_bc():
    ours = twenty_steps(wpc, better_half=1.0, alpha=2.5, weight="static")
    assert_same(ours, twenty_steps(td3_bc, alpha=2.5))


def test_wpc_without_the_q_term_is_wbc():
    assert_same(twenty_steps(wpc, alpha=0.0), twenty_steps(wbc))


def test_td3_bc_without_the_q_term_is_behaviour_cloning():
    torch.manual_seed(1)
    actor = td3_bc.Agent(STATE_DIM, ACTION_DIM, MAX_ACTION, td3_bc.Args()).actor
    optimizer = td3_bc.adam(actor, 3e-4)
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
    theirs = twenty_steps(td3_bc, alpha=0.0)
    for key, parameter in actor.state_dict().items():
        assert torch.equal(parameter, theirs[f"actor.{key}"])


ADVANTAGES = [-1e4, -2.0, -1e-3, 0.0, 1e-3, 0.5, 3.0, 1e4]


def weights_of(kind, seed=0, **options):
    """wpc's weights of `ADVANTAGES`, read off the gradient of the policy's constraint:
    with pi = 0, a = 1 and no Q term, it is proportional to the weight."""
    n = len(ADVANTAGES)
    args = wpc.Args(alpha=0.0, weight=kind, critic_lr=0.0, value_lr=0.0, **options)
    agent = wpc.Agent(n, 1, 1.0, args)
    for parameter in agent.parameters():
        parameter.data.zero_()
    hidden = torch.eye(256)[: 2 * n]
    agent.critic.q1_net[0].weight.data[: 2 * n, :n] = torch.cat(
        [torch.eye(n), -torch.eye(n)]
    )
    agent.critic.q1_net[2].weight.data[: 2 * n] = hidden
    scale = torch.tensor(ADVANTAGES)
    agent.critic.q1_net[4].weight.data[0, :n] = scale  # Q1(s, a) = advantage of s
    agent.actor.net[0].weight.data[:n] = torch.eye(256)[:n, :n]
    agent.actor.net[2].weight.data[:n] = torch.eye(256)[:n]
    states = torch.eye(n)  # entry i of the batch alone reaches weight i of the policy
    column = torch.zeros(n, 1)
    batch = {
        "observations": states,
        "actions": column + 1,
        "rewards": column,
        "next_observations": states,
        "terminals": column,
    }
    torch.manual_seed(seed)
    agent.update(batch, step=2)
    gradient = agent.actor.net[4].weight.grad[0, :n]
    return (-gradient * n / 2).numpy()


def test_binary_weight():
    assert weights_of("binary").tolist() == [0, 0, 0, 0, 1, 1, 1, 1]  # eq. 7: A > 0


@pytest.mark.parametrize("beta", [1.0, 0.1, 10.0])
def test_exponential_weight_is_cut_off_at_100(beta):
    expected = np.exp(np.minimum(np.array(ADVANTAGES) / beta, np.log(100)))  # eq. 8
    assert weights_of("exponential", beta=beta) == pytest.approx(expected, rel=1e-5)


def test_random_weight_is_a_new_permutation_each_time():
    draws = [weights_of("random", seed=seed).tolist() for seed in range(8)]
    assert all(sorted(draw) == [0] * 4 + [1] * 4 for draw in draws)
    assert len({tuple(draw) for draw in draws}) > 4
