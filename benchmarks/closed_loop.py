"""Closed loop in simulation: a hand with an eye reaches for the nearer of two balls beyond the range of its sensor.

    python benchmarks/closed_loop.py --json benchmarks/results/closed_loop.json

Needs MuJoCo (``pip install mujoco==3.3.7``), which is no dependency of dhtorch. It moves the hand and casts the
camera's rays (``mj_multiRay``), so that no OpenGL is needed; colours are a solid texture where a ray ends.

The hand is a carriage on three slides with position actuators; its camera (64×64 px, 60°) looks ahead, the tip is
0.1 m in front of it. Two balls hang in the air before a wall, the nearer one at 0.8 to 1.15 m, the other 0.2 to 0.4 m
farther; their size in the picture, height and texture say nothing of the distance. Boxes stand near the hand. The depth
sensor ends at 0.5 m. An episode begins with a step of 0.12 m to one side, the same for all; then the policy moves the
hand by at most 0.12 m a step, nine steps in all. Reached: the tip comes within 3 cm of the surface of the nearer ball
before it does so to the other.

Every policy has 8×8 tokens: the pixels of a patch, and its depth token (:class:`dhtorch.ExtendDepth`) from

    rgb       nothing
    sensor    the sensor's returns
    far       the sensor's returns and depths recovered with an earlier picture; the motion is the hand's own
    true      a sensor without the limit (positive control)

and is a small network cloned from an expert that has the balls' positions (disturbed actions, squared error). Three
networks each, from other seeds; all drive the same test episodes. Intervals are bootstraps over these episodes, the
networks of an episode together.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from dhtorch import MAP, ExtendDepth
from dhtorch.metrics.bootstrap import Interval, interval_of_statistic
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.transforms import TOKEN_CHANNELS

SIDE, PATCH, FOV_DEG = 64, 8, 60.0  # px, px, degrees
FOCAL = SIDE / 2 / np.tan(np.radians(FOV_DEG / 2))
CUTOFF_M, TIP_M, REACH_M = 0.5, 0.1, 0.03
STEP_M, HORIZON, PEEK_M, DISTURBANCE_M = 0.12, 9, 0.12, 0.05
HOME = np.array([0.0, 0.0, 0.35])  # m, of the camera, before the step to the side
N_SEEDS, N_TRAIN, N_TEST, N_SAMPLES = 3, 100, 50, 256
IMAGE_NOISE, DEPTH_NOISE = 0.01, 0.005  # of white; of the depth
KINEMATICS = (0.002, 0.002)  # rad, m: stated standard deviations of the hand's own motion
CONDITIONS = ("rgb", "sensor", "far", "true")
COMPARED = (("far", "sensor"), ("true", "sensor"), ("far", "rgb"), ("far", "true"))

#: Camera axes (x right, y down, z ahead) in those of the world (x ahead, y left, z up).
WORLD_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

#: Colours of table, wall, two boxes, two balls.
COLOURS = np.array([[0.55, 0.5, 0.45], [0.5, 0.55, 0.6], *[[0.4, 0.6, 0.4]] * 2, *[[0.85, 0.3, 0.25]] * 2])

WORLD = """<mujoco><option timestep=".005"/><worldbody>
<geom type="plane" size="4 4 .1"/><geom type="box" pos="2 0 1" size=".05 3 2"/>{things}
<body name="hand" gravcomp="1" pos="0 0 .35"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<joint name="x" type="slide" axis="1 0 0" damping="40"/><joint name="y" type="slide" axis="0 1 0" damping="40"/>
<joint name="z" type="slide" axis="0 0 1" damping="40"/></body></worldbody>
<actuator><position joint="x" kp="400"/><position joint="y" kp="400"/><position joint="z" kp="400"/></actuator>
</mujoco>"""


class Task(NamedTuple):
    """Balls and boxes of an episode; the first ball is the nearer one."""

    balls: np.ndarray  # (2, 3) m, centres
    radii: np.ndarray  # (2,) m
    boxes: np.ndarray  # (2, 3) m, centres
    start: np.ndarray  # (3,) m, of the camera
    side: float  # 1 or -1: the first step is to the left or right


class View(NamedTuple):
    """What the camera of a hand sees, and where it is."""

    image: np.ndarray  # (3, 64, 64) uint8
    depth: np.ndarray  # (64, 64) m, of the whole range
    position: np.ndarray  # (3,) m


class Views(NamedTuple):
    """Views of B hands."""

    image: np.ndarray  # (B, 3, 64, 64) uint8
    depth: np.ndarray  # (B, 64, 64) m, of the whole range
    position: np.ndarray  # (B, 3) m


# ------------------------------------------------------------------------------------------------------------ the task


def draw_task(rng: np.random.Generator) -> Task:
    """A random task."""
    left = rng.choice([-1.0, 1.0])
    distance = rng.uniform(0.8, 1.15)
    away = np.array([distance, distance + rng.uniform(0.2, 0.4)])
    bearing = np.array([left, -left]) * rng.uniform(0.18, 0.32, 2)  # tangents
    height = rng.uniform(-0.1, 0.2, 2)
    direction = np.stack((np.ones(2), bearing, height), 1)
    start = HOME + rng.uniform(-0.03, 0.03, 3)
    balls = start + away[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    boxes = np.stack((rng.uniform(0.36, 0.44, 2), rng.uniform(0.16, 0.2, 2) * [1, -1], rng.uniform(0.1, 0.2, 2)), 1)
    return Task(balls, away * rng.uniform(0.09, 0.14, 2), boxes, start, rng.choice([-1.0, 1.0]))


def expert_action(task: Task, position: np.ndarray) -> np.ndarray:
    """Straight to the centre of the nearer ball, (3,) m of the camera's axes, at most one step long."""
    return limit_step(WORLD_FROM_CAMERA.T @ (task.balls[0] - tip_of(position)))


def limit_step(action: np.ndarray) -> np.ndarray:
    """Actions (…, 3) m, none longer than one step."""
    length = np.linalg.norm(action, axis=-1, keepdims=True)
    return action * np.minimum(1.0, STEP_M / np.maximum(length, 1e-9))


def tip_of(position: np.ndarray) -> np.ndarray:
    """Tip of the hand from the position of its camera."""
    return position + np.array([TIP_M, 0.0, 0.0])


def reached(task: Task, position: np.ndarray) -> int | None:
    """Number of the ball that the tip is at; None = neither."""
    gaps = np.linalg.norm(task.balls - tip_of(position), axis=1) - task.radii
    return int(gaps.argmin()) if gaps.min() < REACH_M else None


def choose_source(positions: Sequence[np.ndarray]) -> int:
    """The earlier view with the widest baseline across the view, one far behind counting less."""
    moved = np.stack(positions[:-1]) - positions[-1]
    return int((np.linalg.norm(moved[:, 1:], axis=1) - 0.3 * np.abs(moved[:, 0])).argmax())


def join_views(views: Sequence[View]) -> Views:
    """Views of several hands."""
    return Views(*(np.stack(parts) for parts in zip(*views, strict=True)))


# ------------------------------------------------------------------------------------------------------- the simulator


def import_mujoco() -> ModuleType:
    """MuJoCo, or one line on how to get it."""
    try:
        import mujoco
    except ImportError:
        raise SystemExit("closed_loop: mujoco is missing; pip install mujoco==3.3.7") from None
    return mujoco


def pixel_rays() -> np.ndarray:
    """Directions (4096, 3) of the pixels in camera axes, z = 1."""
    v, u = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    centre = (SIDE - 1) / 2
    return np.stack(((u - centre) / FOCAL, (v - centre) / FOCAL, np.ones((SIDE, SIDE))), -1).reshape(-1, 3)


def texture(points: np.ndarray) -> np.ndarray:
    """Brightness about 0 (n,) of points (n, 3) m: waves of 6 to 40 cm."""
    rng = np.random.default_rng(7)
    wave = rng.normal(size=(20, 3))
    wave *= (
        2 * np.pi / (np.exp(rng.uniform(np.log(0.06), np.log(0.4), (20, 1))) * np.linalg.norm(wave, axis=1)[:, None])
    )
    return np.sin(points @ wave.T + rng.uniform(0, 2 * np.pi, 20)).sum(1) / 8


class Hand:
    """One simulated hand before its balls."""

    def __init__(self, mujoco: ModuleType, task: Task, seed: int) -> None:
        shapes = [("box", ".04 .05 .2", at) for at in task.boxes]
        shapes += [("sphere", f"{r:.6f}", at) for r, at in zip(task.radii, task.balls, strict=True)]
        things = "".join(
            f'<geom type="{kind}" size="{size}" pos="{at[0]:.6f} {at[1]:.6f} {at[2]:.6f}"/>'
            for kind, size, at in shapes
        )
        self.mujoco, self.task = mujoco, task
        self.model = mujoco.MjModel.from_xml_string(WORLD.format(things=things))
        self.data = mujoco.MjData(self.model)
        self.rng = np.random.default_rng(seed)
        n = self.model.ngeom
        self.offset, self.scale = self.rng.uniform(-5, 5, (n, 3)), np.exp(self.rng.uniform(-0.3, 0.3, (n, 1)))
        self.hand = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, "hand")
        self.data.qpos[:] = self.data.ctrl[:] = task.start - HOME + [0, -task.side * PEEK_M / 2, 0]
        mujoco.mj_forward(self.model, self.data)
        self.views = [self.see()]
        self.move(np.array([-task.side * PEEK_M, 0.0, 0.0]))  # to the left is -x of the camera

    @property
    def position(self) -> np.ndarray:
        """Of the camera, (3,) m."""
        return self.data.xpos[self.hand].copy()

    def move(self, action: np.ndarray) -> None:
        """Command a displacement (3,) m of the camera's axes, wait 0.4 s, and look."""
        self.data.ctrl[:] += WORLD_FROM_CAMERA @ action
        self.mujoco.mj_step(self.model, self.data, 80)
        self.views.append(self.see())

    def source(self) -> View:
        """The earlier view that depth is recovered with."""
        return self.views[choose_source([view.position for view in self.views])]

    def see(self) -> View:
        """Image and depth, with noise."""
        rays = pixel_rays()
        length = np.linalg.norm(rays, axis=1)
        directions = (rays / length[:, None]) @ WORLD_FROM_CAMERA.T
        geom, distance = np.zeros(len(rays), np.int32), np.zeros(len(rays))
        self.mujoco.mj_multiRay(
            self.model,
            self.data,
            self.position,
            directions.ravel(),
            None,
            1,
            self.hand,
            geom,
            distance,
            len(rays),
            10.0,
        )
        hit = geom >= 0
        points = self.position + directions * distance[:, None] - self.data.geom_xpos[geom]
        shade = 1 + 0.5 * texture(points * self.scale[geom] + self.offset[geom])[:, None]
        colour = np.where(hit[:, None], COLOURS[geom] * shade, 0.8) + self.rng.normal(0, IMAGE_NOISE, (len(rays), 3))
        depth = np.where(hit, distance / length * (1 + self.rng.normal(0, DEPTH_NOISE, len(rays))), 0.0)
        image = (255 * colour.clip(0, 1)).round().astype(np.uint8)
        return View(image.reshape(SIDE, SIDE, 3).transpose(2, 0, 1), depth.reshape(SIDE, SIDE), self.position)


# --------------------------------------------------------------------------------------------------------- the tokens


def small_method() -> Any:
    """``map`` with windows for pictures of 64 px."""
    track = partial(lucas_kanade_affine, track=partial(lucas_kanade, window=9, levels=3), window=9, levels=3)
    return MAP.replace(track=track)


class Tokens:
    """Depth tokens of B views by condition: (B, 64, 10)."""

    def __init__(self) -> None:
        options: dict[str, Any] = {"method": small_method(), "n": N_SAMPLES, "patch": PATCH, "batched": True}
        options["on_error"] = "flag"  # a camera that touches something
        self.alone = ExtendDepth(depth_unit="m", **options)
        self.pair = ExtendDepth(depth_unit="m", pose="pose", pose_cov=KINEMATICS, **options)
        centre = (SIDE - 1) / 2
        self.K = torch.tensor([FOCAL, FOCAL, centre, centre], dtype=torch.float32)

    def compute(self, now: Views, source: Views, conditions: Sequence[str]) -> dict[str, Tensor]:
        """Tokens of the present views, ``source`` the earlier view of each hand."""
        short = np.where(now.depth < CUTOFF_M, now.depth, 0.0)
        short_source = np.where(source.depth < CUTOFF_M, source.depth, 0.0)
        found: dict[str, Tensor] = {}
        for name in conditions:
            if name == "rgb":
                found[name] = torch.zeros(len(now.image), (SIDE // PATCH) ** 2, len(TOKEN_CHANNELS))
            elif name == "far":
                found[name] = self._run(self.pair, [source, now], [short_source, short])
            else:
                found[name] = self._run(self.alone, [now], [short if name == "sensor" else now.depth])
        return found

    @torch.no_grad()
    def _run(self, transform: ExtendDepth, views: Sequence[Views], depths: Sequence[np.ndarray]) -> Tensor:
        sample: dict[str, Any] = {
            "image": torch.from_numpy(np.stack([v.image for v in views], 1)),
            "depth": torch.from_numpy(np.stack(depths, 1)).float(),
            "intrinsics": self.K.expand(len(views[0].image), 4),
            "pose": torch.from_numpy(np.stack([camera_poses(v.position) for v in views], 1)),
        }
        added = transform(sample)
        assert added is not None
        return added["dhtorch.tokens"]


def camera_poses(position: np.ndarray) -> np.ndarray:
    """Camera-to-world (B, 4, 4) of cameras that look ahead."""
    T = np.tile(np.eye(4), (len(position), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = WORLD_FROM_CAMERA, position
    return T


def picture_tokens(image: np.ndarray) -> Tensor:
    """Pictures (B, 3, 64, 64) uint8 -> pixels of their patches, (B, 64, 192) about 0."""
    return nn.functional.unfold(torch.from_numpy(image).float() / 255 - 0.5, PATCH, stride=PATCH).mT.contiguous()


class Policy(nn.Module):
    """Pixels and depth tokens of 64 patches, and hand positions -> displacements, (B, 3) steps.

    Eight attention maps over the patches, as a spatial softmax: where they are, and what is there.
    """

    def __init__(self, width: int = 32, maps: int = 8) -> None:
        super().__init__()
        self.embed = nn.Linear(3 * PATCH**2 + len(TOKEN_CHANNELS), width)
        self.mix, self.attend = nn.Linear(width, width), nn.Linear(width, maps)
        grid = torch.linspace(-1, 1, SIDE // PATCH)
        self.register_buffer("place", torch.stack(torch.meshgrid(grid, grid, indexing="ij"), -1).flatten(0, 1))
        self.head = nn.Sequential(nn.Linear(maps * (width + 2) + 3, 64), nn.ReLU(), nn.Linear(64, 3))

    def forward(self, pixels: Tensor, tokens: Tensor, position: Tensor) -> Tensor:
        """Actions."""
        x = torch.relu(self.mix(torch.relu(self.embed(torch.cat((pixels, tokens), -1)))))
        share = self.attend(x).softmax(1).mT
        seen = share @ torch.cat((x, self.place.expand(len(x), -1, -1)), -1)
        return self.head(torch.cat((seen.flatten(1), position), -1))


# ------------------------------------------------------------------------------------------------- training and driving


def look(hands: Sequence[Hand]) -> tuple[Views, Views]:
    """Present views of the hands, and the earlier ones that depth is recovered with."""
    return join_views([hand.views[-1] for hand in hands]), join_views([hand.source() for hand in hands])


class Demonstrations(NamedTuple):
    """Training data, one row a step."""

    pixels: Tensor
    position: Tensor
    action: Tensor  # steps
    tokens: Mapping[str, Tensor]


def demonstrate(mujoco: ModuleType, n: int, tokens: Tokens, seed: int = 1000) -> Demonstrations:
    """The expert's answers along its own disturbed ways."""
    rng = np.random.default_rng(seed)
    hands = [Hand(mujoco, draw_task(rng), seed + k) for k in range(n)]
    rows: list[tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]] = []
    for _ in range(HORIZON):
        now, source = look(hands)
        wanted = np.stack([expert_action(hand.task, hand.position) for hand in hands])
        found = tokens.compute(now, source, CONDITIONS)
        steps = torch.from_numpy(wanted / STEP_M).float()
        rows.append((picture_tokens(now.image), relative(now.position), steps, found))
        for hand, action in zip(hands, wanted, strict=True):
            hand.move(limit_step(action + rng.normal(0, DISTURBANCE_M, 3)))
        hands = [hand for hand in hands if reached(hand.task, hand.position) is None]
    pixels, position, action, found_all = zip(*rows, strict=True)
    joined = {name: torch.cat([found[name] for found in found_all]) for name in CONDITIONS}
    return Demonstrations(torch.cat(pixels), torch.cat(position), torch.cat(action), joined)


def relative(position: np.ndarray) -> Tensor:
    """Positions from home: the robot's own state."""
    return torch.from_numpy(position - HOME).float()


def clone_expert(data: Demonstrations, condition: str, seed: int, epochs: int) -> Policy:
    """A policy trained on the demonstrations."""
    torch.manual_seed(seed)
    policy, n, size = Policy(), len(data.action), 64
    optimiser = torch.optim.AdamW(policy.parameters(), lr=1e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 6e-3, total_steps=epochs * (n // size))
    for _ in range(epochs):
        for rows in torch.randperm(n)[: n // size * size].view(-1, size):
            answer = policy(data.pixels[rows], data.tokens[condition][rows], data.position[rows])
            loss = (answer - data.action[rows]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return policy.eval()


@torch.no_grad()
def drive(mujoco: ModuleType, tasks: Sequence[Task], policy: Policy, condition: str, tokens: Tokens) -> dict[str, Any]:
    """Episodes of a policy: outcome of each (1 the nearer ball, -1 the other, 0 neither)."""
    hands = {k: Hand(mujoco, task, 5000 + k) for k, task in enumerate(tasks)}
    outcome = np.zeros(len(tasks), int)
    for _ in range(HORIZON):
        if not hands:
            break
        now, source = look(list(hands.values()))
        found = tokens.compute(now, source, [condition])[condition]
        actions = policy(picture_tokens(now.image), found, relative(now.position)).numpy() * STEP_M
        for (k, hand), action in zip(list(hands.items()), limit_step(actions), strict=True):
            hand.move(action.astype(float))
            if (at := reached(hand.task, hand.position)) is not None:
                outcome[k] = 1 if at == 0 else -1
                del hands[k]
    return {"condition": condition, "outcome": outcome.tolist()}


def expert_success(mujoco: ModuleType, tasks: Sequence[Task]) -> float:
    """Share of the tasks that the expert solves within the horizon."""
    done = 0
    for k, task in enumerate(tasks):
        hand, at = Hand(mujoco, task, 5000 + k), None
        for _ in range(HORIZON):
            if at is None:
                hand.move(expert_action(task, hand.position))
                at = reached(task, hand.position)
        done += at == 0
    return done / len(tasks)


# ------------------------------------------------------------------------------------------------------------- results


def success_interval(outcomes: np.ndarray) -> Interval:
    """Success rate of outcomes (seeds, episodes) with a 95 % interval from resampling episodes."""
    by_episode = torch.from_numpy((outcomes == 1).mean(0))
    return interval_of_statistic(lambda index: by_episode[index].mean(-1), len(by_episode))


def difference_interval(ours: np.ndarray, theirs: np.ndarray) -> Interval:
    """Difference of two success rates on the same episodes, paired, with a 95 % interval."""
    by_episode = torch.from_numpy((ours == 1).mean(0) - (theirs == 1).mean(0))
    return interval_of_statistic(lambda index: by_episode[index].mean(-1), len(by_episode))


def summarise(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rates by condition, and the differences of :data:`COMPARED`."""
    outcomes = {c: np.array([run["outcome"] for run in runs if run["condition"] == c]) for c in CONDITIONS}
    rates = {
        c: {
            "success": success_interval(x).entry(),
            "by_seed": (x == 1).mean(1).tolist(),
            "wrong_ball": float((x == -1).mean()),
            "neither": float((x == 0).mean()),
        }
        for c, x in outcomes.items()
    }
    return {
        "rates": rates,
        "differences": {f"{a} - {b}": difference_interval(outcomes[a], outcomes[b]).entry() for a, b in COMPARED},
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--train", type=int, default=N_TRAIN, help="episodes")
    parser.add_argument("--test", type=int, default=N_TEST, help="episodes")
    parser.add_argument("--seeds", type=int, default=N_SEEDS)
    parser.add_argument("--epochs", type=int, default=30)
    args = parser.parse_args()
    mujoco, tokens, began = import_mujoco(), Tokens(), time.process_time()
    torch.set_num_threads(1)
    data = demonstrate(mujoco, args.train, tokens)
    print(f"{len(data.action)} steps shown, {time.process_time() - began:.0f} s of processor time", flush=True)
    rng = np.random.default_rng(2000)
    tasks = [draw_task(rng) for _ in range(args.test)]
    expert = expert_success(mujoco, tasks)
    print(f"expert {expert:.2f}", flush=True)
    runs: list[dict[str, Any]] = []
    for seed in range(args.seeds):
        for condition in CONDITIONS:
            policy = clone_expert(data, condition, seed, args.epochs)
            runs.append({"seed": seed, **drive(mujoco, tasks, policy, condition, tokens)})
            rate = np.mean(np.array(runs[-1]["outcome"]) == 1)
            print(f"{condition} {seed}: {rate:.2f}, {time.process_time() - began:.0f} s", flush=True)
    summary = summarise(runs)
    result = {
        "simulator": f"mujoco {mujoco.__version__}",
        "git": result_files.read_git_revision(Path(__file__).parent),
        "processor": result_files.describe_processor(),
        "processor_s": round(time.process_time() - began),
        "train_episodes": args.train,
        "test_episodes": args.test,
        "seeds": args.seeds,
        "epochs": args.epochs,
        "expert": expert,
        **summary,
        "runs": runs,
    }
    if args.json:
        storage.write_json(args.json, [result])


if __name__ == "__main__":
    main()
