# SPDX-License-Identifier: MIT
"""TD3+BC: A Minimalist Approach to Offline Reinforcement Learning (Fujimoto and Gu, NeurIPS 2021) in one file.

The policy maximises Q and stays near the dataset's actions:

    pi = argmax E[ lmbda * Q(s, pi(s)) - (pi(s) - a)^2 ]  (eq. 4 of Peng et al., AAAI 2023, called the paper below)
"""

import contextlib, copy, csv, fcntl, hashlib, io, json, os, signal, socket, sys, threading, time, warnings, zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import h5py
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

SCRIPT = Path(__file__).stem
ROBOTS = {  # Gymnasium's environment (-v4 is the closest to D4RL's -v2), and the returns that D4RL scores 0 and 100
    "halfcheetah": ("HalfCheetah-v4", -280.178953, 12135.0),
    "hopper": ("Hopper-v4", -20.272305, 3234.3),
    "walker2d": ("Walker2d-v4", 1.629008, 4592.3),
}
KINDS = ("random", "medium", "medium-replay", "full-replay", "medium-expert", "expert")
SHA256 = {  # the first 16 digits for D4RL's file of each kind
    "halfcheetah": "25407aef85b5d16c 41324e8487a9556d 48d494a4770c11f4 27fdf7ea86e5a2cb 015db75dae5bbe8e d9fe53bb994eb1e2",
    "hopper": "63103ef7059db4c0 5bdf1bc4a713c829 e121c5f7c9857a30 56baf95963c51c1e 9d51ad87f8c905be 01aa219a5f8eea5e",
    "walker2d": "4e863bb6090cf4a4 cf00f43add04c17f e75de96a4f77acf7 f2720f9d27b2acef 6b8d7f868c45bbae 2985dc3d436a8baa",
}
SERVER = "http://rail.eecs.berkeley.edu/datasets/offline_rl/gym_mujoco_v2/"  # D4RL's own, often down
MIRROR = "https://huggingface.co/datasets/imone/D4RL/resolve/main/"


@dataclass
class Args:
    env: str = "hopper-medium-v2"  # D4RL task or, with --dataset, just the robot: halfcheetah, hopper, walker2d
    dataset: str | None = None  # HDF5 file in D4RL's format; by default D4RL's for --env, downloaded on first use
    seed: int = 0  # of the networks, the batches and the noise, and, plus 100, of the evaluation's initial states
    max_timesteps: int = 1_000_000  # training steps
    eval_freq: int = 5_000  # training steps from one evaluation, with its checkpoint, to the next
    eval_episodes: int = 10  # episodes of an evaluation
    batch_size: int = 256  # transitions of a training step
    discount: float = 0.99  # gamma
    tau: float = 0.005  # rate at which the target networks follow
    policy_noise: float = 0.2  # sigma of the noise on the target's action
    noise_clip: float = 0.5  # bound c of that noise
    policy_freq: int = 2  # training steps from one update of the policy, and of all targets, to the next
    policy_lr: float = 3e-4  # learning rate of the policy
    q_lr: float = 3e-4  # learning rate of the critics
    alpha: float = 2.5  # weight of Q against the constraint
    normalize: bool = True  # shift and scale the observations to mean 0 and standard deviation 1 over the dataset
    device: Literal["auto", "cpu", "cuda"] = "auto"  # where to train; auto takes a GPU if there is one
    cudagraphs: bool = False  # on a GPU: launch each training step as one CUDA graph; no GPU has run this yet
    log_freq: int = 1_000  # training steps from one entry in TensorBoard, a mean over them, to the next
    run_dir: str | None = None  # folder of the run, begun or continued; by default a new one under runs/


def mlp(inputs, outputs):
    relu = nn.ReLU(inplace=True)
    return nn.Sequential(nn.Linear(inputs, 256), relu, nn.Linear(256, 256), relu, nn.Linear(256, outputs))


def make_networks(obs_dim, action_dim, args, device):
    """The networks of Table 4 and the optimizers of those that learn: two dicts by name, fixed by `args.seed`."""
    torch.manual_seed(args.seed)
    critic = nn.ModuleList(mlp(obs_dim + action_dim, 1) for _ in range(2))  # Q1 and Q2
    actor = mlp(obs_dim, action_dim).append(nn.Tanh())  # pi: normalized s -> a within +-1, each robot's limits
    networks = {"actor": actor, "critic": critic}
    networks |= {f"{name}_target": copy.deepcopy(network).requires_grad_(False) for name, network in networks.items()}
    networks = {name: network.to(device) for name, network in networks.items()}
    optimizers = {"actor": torch.optim.Adam(actor.parameters(), args.policy_lr, fused=True, capturable=True)}
    optimizers["critic"] = torch.optim.Adam(critic.parameters(), args.q_lr, fused=True, capturable=True)
    return networks, optimizers


def dataset_path(args):
    """The file of --dataset, or D4RL's for --env, downloaded if need be; exits with a sentence if there is none."""
    robot, _, kind = args.env.removesuffix("-v2").partition("-")
    folder = Path(os.environ.get("D4RL_DATASET_DIR") or Path.home() / ".d4rl/datasets")
    path = Path(args.dataset or folder / f"{robot}_{kind.replace('-', '_')}-v2.hdf5")
    problems = []
    for server in () if args.dataset or path.exists() else (SERVER, MIRROR):
        try:  # into a temporary file, moved to its place when it is complete and right
            folder.mkdir(parents=True, exist_ok=True)
            socket.setdefaulttimeout(30)  # seconds that a server may be silent
            torch.hub.download_url_to_file(server + path.name, path, SHA256[robot].split()[KINDS.index(kind)])
            break
        except Exception as error:  # of the network, of HTTP, of the digest: the next server may do
            problems.append(f"; {server}: {error}")
    if not path.exists():
        ships = "--env halfcheetah --dataset tests/data/halfcheetah_replay.hdf5 ships with the project"
        sys.exit(f"there is no {path}{''.join(problems)}: put D4RL's file there, or name one with --dataset ({ships})")
    return path


def read_column(file, key, rows, width):
    """`file[key]` as finite float32 (rows, width); exits with a sentence where it is not."""
    shape = getattr(file.get(key), "shape", "missing")
    if shape != (rows, width) and (shape, width) != ((rows,), 1):
        sys.exit(f"{file.filename}: '{key}' is {shape}, where {(rows, width)} was expected")
    column = file[key][:].astype(np.float32, copy=False).reshape(rows, width)
    if not np.isfinite(column).all():
        sys.exit(f"{file.filename}: '{key}' is not finite in row {np.argwhere(~np.isfinite(column))[0, 0]}")
    return column


def episode_steps(end):
    """Each row's episode and its step within it, both (rows,), from `end` (rows,), true on an episode's last row."""
    episode = np.cumsum(end) - end
    return episode, np.arange(len(end)) - np.searchsorted(episode, episode)


def load_dataset(path, obs_dim, action_dim, args):
    """The transitions of `d4rl.qlearning_dataset` from an HDF5 file in D4RL's format, on the CPU.

    Row i becomes (o[i], a[i], r[i], o[i+1], terminal[i]). Rows that end an episode by a timeout are dropped, for their
    o[i+1] belongs to the next episode, and so is the last row. Without `timeouts`, an episode ends after 1000 steps.

    Returns transitions, float32 (N, sum(widths)), whose columns are s, a, r, not_done, s_next;
    then mean and std, float32 (obs_dim,), that normalize s and s_next; widths; returns, float64 (episodes,), and the
    best discounted one. Exits with a sentence if the file is no HDF5, damaged, incomplete, empty or does not fit.
    """
    try:
        with h5py.File(path) as file:
            rows = len(file["observations"]) if "observations" in file else 0
            observations = read_column(file, "observations", rows, obs_dim)
            actions = read_column(file, "actions", rows, action_dim)
            rewards = read_column(file, "rewards", rows, 1)
            terminal = read_column(file, "terminals", rows, 1)[:, 0] != 0
            timeout = episode_steps(terminal)[1] % 1000 == 999  # d4rl's own count is off by one after a terminal
            if "timeouts" in file:
                timeout = read_column(file, "timeouts", rows, 1)[:, 0] != 0
    except Exception as error:  # which one h5py raises depends on the byte that is wrong
        sys.exit(f"{path} is no HDF5 file, or is damaged or cut short ({error})")
    keep = np.flatnonzero(~timeout[:-1])
    if len(keep) == 0:
        sys.exit(f"{path} has no transitions, only {rows} rows")
    episode, t = episode_steps(terminal | timeout)
    returns = np.bincount(episode, rewards[:, 0])
    best_return = np.bincount(episode, rewards[:, 0] * args.discount**t).max()
    columns = [observations, actions, rewards, ~terminal[:, None], observations[1:]]
    widths = [column.shape[1] for column in columns]
    transitions = np.empty((len(keep), sum(widths)), np.float32)  # one array: a batch is one look-up
    views = np.split(transitions, np.cumsum(widths)[:-1], axis=1)
    for view, column in zip(views, columns):
        view[:] = column[keep]
    mean = np.float32([x.mean(dtype=np.float64) if args.normalize else 0 for x in views[0].T])
    std = np.float32([x.std(dtype=np.float64) + 1e-3 if args.normalize else 1 for x in views[0].T])
    for s in (views[0], views[4]):
        np.divide(s - mean, std, out=s)
    return *map(torch.from_numpy, (transitions, mean, std)), widths, returns, float(best_return)


@torch.inference_mode()
def evaluate(envs, actor, mean, std, seed):
    """The return of the first episode of each of `envs`, float64 (num_envs,); `seed` fixes the initial states."""
    actor = copy.deepcopy(actor).cpu()  # where so small a batch is faster
    observations, _ = envs.reset(seed=np.random.SeedSequence(seed + 100).generate_state(envs.num_envs).tolist())
    returns, running = np.zeros(envs.num_envs), np.ones(envs.num_envs, bool)
    while running.any():
        s = (torch.as_tensor(observations, dtype=torch.float32) - mean) / std
        observations, rewards, terminated, truncated, _ = envs.step(actor(s).numpy())
        returns += running * rewards
        running &= ~(terminated | truncated)
    return returns


def minimize(loss, optimizer):
    """One step of Adam on the optimizer's own parameters: the actor's loss reaches the critics' as well."""
    optimizer.zero_grad()
    loss.backward(inputs=[parameter for group in optimizer.param_groups for parameter in group["params"]])
    optimizer.step()


def update(networks, optimizers, batch, args, step, rng):
    """Step `step` (from 1 on) of Algorithm 1, on columns (B, width) of `load_dataset`; returns its metrics by name."""
    actor, critic, actor_target, critic_target, *_ = networks.values()
    s, a, r, not_done, s_next = batch

    with torch.no_grad():
        noise = args.policy_noise * torch.randn(a.shape, generator=rng, device=a.device)
        a_next = (actor_target(s_next) + noise.clamp(-args.noise_clip, args.noise_clip)).clamp(-1, 1)
        sa_next = torch.cat([s_next, a_next], 1)
        y = r + args.discount * not_done * torch.minimum(*(q(sa_next) for q in critic_target))

    sa = torch.cat([s, a], 1)
    q1, q2 = (q(sa) for q in critic)
    critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
    metrics = {"q": q1.mean(), "target_q": y.mean(), "critic_loss": critic_loss}
    minimize(critic_loss, optimizers["critic"])

    if step % args.policy_freq == 0:
        pi = actor(s)
        q = critic[0](torch.cat([s, pi], 1))
        lmbda = args.alpha / q.abs().mean().detach()
        actor_loss = -lmbda * q.mean() + ((pi - a) ** 2).mean()  # eq. 4
        minimize(actor_loss, optimizers["actor"])
        metrics |= {"actor_loss": actor_loss, "action_distance": (pi - a).abs().mean()}
        metrics["lmbda"] = lmbda

        with torch.no_grad():
            for target, network in ((critic_target, critic), (actor_target, actor)):
                torch._foreach_lerp_(list(target.parameters()), list(network.parameters()), args.tau)
    return {name: metric.detach() for name, metric in metrics.items()}


def parse_args(argv=None):
    """The arguments, checked; where --run-dir holds a run, those not given are its own."""
    args = tyro.cli(Args, args=argv, description=__doc__)
    if checkpoint := load_checkpoint(args.run_dir) if args.run_dir else None:
        if checkpoint.get("script") != SCRIPT:
            sys.exit(f"{args.run_dir} holds no run of {SCRIPT}.py but another's: choose another --run-dir")
        saved = checkpoint["args"] | {"run_dir": args.run_dir}
        args = tyro.cli(Args, args=argv, default=Args(**saved))
        for name in saved.keys() - {"max_timesteps", "device", "cudagraphs", "dataset"}:
            if getattr(args, name) != saved[name]:
                sys.exit(f"the run in {args.run_dir} has {name} {saved[name]}: keep that, or choose another --run-dir")
    tasks = [f"{robot}-{kind}-v2" for robot in ROBOTS for kind in KINDS]
    if args.env not in tasks and not (args.dataset and args.env in ROBOTS):
        sys.exit(f"--env {args.env} is none of {', '.join(tasks)}; with --dataset also {', '.join(ROBOTS)}")
    if (args.device == "cuda" or args.cudagraphs) and (args.device == "cpu" or not torch.cuda.is_available()):
        sys.exit("--device cuda and --cudagraphs need a GPU: leave them out")
    for name, value in asdict(args).items():
        low, high = (0, 1) if name in ("discount", "tau") else (0 if type(value) is float or name == "seed" else 1, 1e9)
        if type(value) in (int, float) and not low <= value <= high:
            sys.exit(f"--{name.replace('_', '-')} is {value}, but must be from {low} to {high:g}")
    return args


def save_checkpoint(run_dir, checkpoint):
    """Writes checkpoint.pt, args.json and evaluations.csv, all or none; the last checkpoint becomes previous.pt."""
    table, content = io.StringIO(), io.BytesIO()
    columns = dict.fromkeys(column for row in checkpoint["rows"] for column in row)
    writer = csv.DictWriter(table, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(checkpoint["rows"])
    torch.save(checkpoint, content)  # to memory: to a full disk it would raise no OSError
    files = {"args.json": json.dumps(checkpoint["args"], indent=2).encode()}
    files |= {"evaluations.csv": table.getvalue().encode(), "checkpoint.pt": content.getvalue()}
    for name, content in files.items():
        (run_dir / f"{name}.part").write_bytes(content)
    if (run_dir / "checkpoint.pt").exists():
        os.replace(run_dir / "checkpoint.pt", run_dir / "previous.pt")
    for name in files:
        os.replace(run_dir / f"{name}.part", run_dir / name)


def load_checkpoint(run_dir):
    """A folder's last checkpoint, on the CPU, or None. Runs nothing in it; exits with a sentence if it is damaged."""
    for path in (Path(run_dir, "checkpoint.pt"), Path(run_dir, "previous.pt")):  # the second alone: stopped in saving
        if path.exists():
            with contextlib.suppress(Exception):
                if zipfile.ZipFile(path).testzip() is None:  # the CRCs, which torch.load does not check
                    return torch.load(path, map_location="cpu", weights_only=True)
            sys.exit(f"{path} is damaged: delete it to go on from the checkpoint before it, previous.pt, if it is there")


def train(args):
    """Runs Algorithm 1 with evaluations, logs and checkpoints, from the start or from where --run-dir stopped."""
    warnings.filterwarnings("ignore", ".*(out of date|capturable)")  # Gymnasium's on -v4, Adam's outside of CUDA graphs
    env_id, low, high = ROBOTS[args.env.split("-")[0]]
    envs = gym.make_vec(env_id, args.eval_episodes, vectorization_mode="sync")
    obs_dim, action_dim = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    device = torch.device("cuda" if args.device != "cpu" and torch.cuda.is_available() else "cpu")
    networks, optimizers = make_networks(obs_dim, action_dim, args, device)
    path = dataset_path(args)
    transitions, mean, std, widths, returns, best_return = load_dataset(path, obs_dim, action_dim, args)
    sha256 = hashlib.sha256(transitions.numpy()).hexdigest()
    name = f"{path.stem if args.dataset else args.env}__{SCRIPT}__{args.seed}"
    run_dir = Path(args.run_dir or f"runs/{name}__{time.strftime('%Y-%m-%d_%H-%M-%S')}_{os.getpid()}")
    run_dir.mkdir(parents=True, exist_ok=True)
    lock = open(run_dir / "lock", "w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until this process ends, however it does
    except BlockingIOError:
        sys.exit(f"{run_dir} is in use by another process")
    rng = torch.Generator(device).manual_seed(args.seed)  # of batches and noise, whatever the networks drew
    start, rows, history = 0, [], {}  # history: the metrics of each step since they were logged
    if checkpoint := load_checkpoint(run_dir):
        if checkpoint["sha256"] != sha256:
            sys.exit(f"the run in {run_dir} is on other data than {path}: choose another --run-dir")
        start, rows = checkpoint["step"], checkpoint["rows"]
        for kind, parts in (("networks", networks), ("optimizers", optimizers)):
            for name, part in parts.items():
                part.load_state_dict(checkpoint[kind][name])
        history = {name: list(values.to(device)) for name, values in checkpoint["history"].items()}
        if checkpoint["device"] == device.type:  # else the state does not fit
            rng.set_state(checkpoint["rng"])

    scores = 100 * (returns - low) / (high - low)
    print(f"task     {args.env}, evaluated in {env_id}; seed {args.seed}")
    print(f"dataset  {path}: {len(transitions):,} transitions of {len(scores):,} episodes")
    print(f"         score {scores.mean():.1f}, at best {scores.max():.1f}; best discounted return {best_return:.1f}")
    print(f"run      {run_dir}, from step {start:,} on; {device} with {torch.get_num_threads()} threads")
    transitions, stopped = transitions.to(device), []
    for number in (signal.SIGINT, signal.SIGTERM):  # heard between two steps; a second one acts at once
        signal.signal(number, lambda number, _: (stopped.append(number), signal.signal(number, signal.SIG_DFL)))

    def train_step(step):
        i = torch.randint(len(transitions), (args.batch_size,), generator=rng, device=device)
        return update(networks, optimizers, transitions[i].split(widths, dim=1), args, step, rng)
    graphs, results, metrics, warned, clock, clock_step = {}, {}, {}, False, time.perf_counter(), start
    writer = SummaryWriter(run_dir, purge_step=start + 1 if checkpoint else 0)
    with writer, tqdm(desc=SCRIPT, initial=start, total=args.max_timesteps, unit="step", disable=None) as progress:
        for step in range(start, args.max_timesteps + 1):
            if step > start:
                kind = step % args.policy_freq == 0  # with the policy's update or without it
                if args.cudagraphs and kind not in graphs and step > start + 2 * args.policy_freq:  # Adam is set up
                    graphs[kind] = torch.cuda.CUDAGraph()
                    graphs[kind].register_generator_state(rng)
                    with torch.cuda.graph(graphs[kind]):  # records the step and runs nothing
                        results[kind] = train_step(step)
                if kind in graphs:
                    graphs[kind].replay()
                else:
                    results[kind] = train_step(step)
                for name, metric in results[kind].items():
                    history.setdefault(name, []).append(metric.clone())  # the next replay overwrites it
                progress.update()
            due = (step % args.eval_freq == 0 or step == args.max_timesteps) and (not rows or rows[-1]["step"] < step)
            if history and (due or step % args.log_freq == 0):
                metrics = {name: torch.stack(values).mean().item() for name, values in history.items()}
                history.clear()
                speed = (step - clock_step) / (time.perf_counter() - clock)
                metrics |= {"best_discounted_return": best_return, "steps_per_second": speed}
                clock, clock_step = time.perf_counter(), step
                for name, metric in metrics.items():
                    writer.add_scalar(f"train/{name}", metric, step)
                shown = {"score": rows[-1]["score"]} | metrics
                progress.set_postfix({name: f"{shown[name]:.3g}" for name in ("score", "q", "weight") if name in shown})
                if metrics["target_q"] > 2 * abs(best_return) and not warned:
                    warned = True
                    progress.write(f"step {step:,}: Q is over twice the data's best discounted return: try a smaller --alpha")
            if due or stopped or step % args.log_freq == 0:
                sums = {name: sum(x.detach().sum() for x in network.parameters()) for name, network in networks.items()}
                if bad := [name for name, value in (metrics | sums).items() if not np.isfinite(float(value))]:
                    sys.exit(f"diverged by step {step}: not finite are {', '.join(bad)}; the last checkpoint is kept")
            if due:
                returns = evaluate(envs, networks["actor"], mean, std, args.seed)
                scores = 100 * (returns - low) / (high - low)
                row = {"step": step, "score": scores.mean().item(), "score_std": scores.std().item()}
                rows.append(row | {"returns": " ".join(f"{x:.2f}" for x in returns)} | metrics)
                writer.add_scalar("eval/score", row["score"], step)
                progress.write(f"step {step:>9,}  score {row['score']:6.2f} +- {row['score_std']:5.2f}")
                clock = time.perf_counter()
            if due or stopped:
                checkpoint = {"script": SCRIPT, "args": asdict(args), "sha256": sha256, "step": step, "rows": rows}
                checkpoint |= {"mean": mean, "std": std, "device": device.type, "rng": rng.get_state()}
                checkpoint["history"] = {name: torch.stack(values) for name, values in history.items()}
                checkpoint["networks"] = {name: network.state_dict() for name, network in networks.items()}
                checkpoint["optimizers"] = {name: optimizer.state_dict() for name, optimizer in optimizers.items()}
                writer.flush()
                save_checkpoint(run_dir, checkpoint)
            if stopped:
                progress.write(f"stopped at step {step:,}; to go on: python {SCRIPT}.py --run-dir {run_dir}")
                sys.exit(128 + stopped[0])
    last = [row["score"] for row in rows[-10:]]
    print(f"finished step {rows[-1]['step']:,}: score {last[-1]:.2f}, mean of the last {len(last)} {np.mean(last):.2f}")
    print(f"files    {run_dir}/: evaluations.csv, checkpoint.pt, args.json, TensorBoard's events")


if __name__ == "__main__":
    sys.stdout.reconfigure(line_buffering=True)  # a log file is up to date, however the run ends
    threading.excepthook = lambda _: None  # TensorBoard's writer: its error comes up again in flush()
    try:
        train(parse_args())
    except KeyboardInterrupt:
        sys.exit("interrupted before the first step")
    except OSError as error:  # a full disk, a read-only folder
        sys.exit(f"{error}: what was saved before is intact")
