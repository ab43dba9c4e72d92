"""Invariants of the training program, on a task space that compiles fast."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

import envs
from apt_jax import checkpoint, workers
from apt_jax.bonuses import BONUSES
from apt_jax.config import PRESETS, Config, HParams, ranges
from apt_jax.descent import has_learned
from apt_jax.evaluation import diversity
from apt_jax.lanes import _spread, lane_bytes, make_program, room, stack_hparams, stack_targets
from apt_jax.methods import METHODS, Method, parse_method
from apt_jax.specs import Grid, Vector
from apt_jax.task_space import task_struct
from apt_jax.trainer import Clock, make_trainer
from experiments import episodes
from experiments.examples.corridor import Corridor

SPACE = Corridor()
TARGET = np.int32(7)
CONFIG = Config(
    envs_per_source=2,
    warmup_steps=100,
    updates_per_step=1,
    batch_size=16,
    replay_steps=200,
    replay_episodes=64,
    model_updates_per_step=0.5,
    model_batch_size=8,
    recent_steps=100,
    refresh_every=20,
    eval_every=40,
    eval_episodes=2,
    probe_tasks=8,
    return_window=10,
    alp_window=8,
    alp_history=16,
    alp_fit_every=20,
    goal_tasks=8,
)
EVERYTHING = "apt_gen+rnd"
"""A curriculum that learns and a bonus that does: the method of tests that any would do for, which share its programs."""

PAPER, FAST = (dataclasses.asdict(PRESETS[preset][0]) for preset in ("paper", "fast"))
SWITCHES = {name: FAST[name] for name in FAST if FAST[name] != PAPER[name] == getattr(CONFIG, name)}
"""What preset "fast" does otherwise than the paper, beyond the sizes that are made small here."""


def config(method: str, **changes) -> Config:
    """A small configuration with everything switched on that preset "fast" does."""
    return dataclasses.replace(CONFIG, method=method, **SWITCHES | changes)


def targets(lanes):
    """The same for every lane."""
    return stack_targets([TARGET] * lanes)


@functools.cache
def program(cfg, lanes, layout):
    """Compiled once for all tests."""
    return make_program(make_trainer(SPACE, cfg), lanes, layout=layout)


def run(cfg, seeds, chunks=2, layout="map", hparams=None, goals=None):
    """States and metrics of every chunk for some seeds."""
    compiled = program(cfg, len(seeds), layout)
    lanes = stack_hparams(hparams or [HParams()] * len(seeds))
    goals = stack_targets(goals or [TARGET] * len(seeds))
    states = compiled.init(jax.vmap(jax.random.key)(np.array(seeds)), goals, lanes)
    states, clock = compiled.warmup(states, Clock.start(), lanes)
    history = []
    for _ in range(chunks):
        states, clock, metrics = compiled.chunk(states, clock, lanes)
        history.append(metrics)
    return states, clock, history


def leaves(tree):
    """Comparable numpy leaves, keys as their data."""
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x) for x in jax.tree.leaves(tree)
    ]


def assert_lane_equal(several, lane, alone, rtol=1e-4, atol=1e-5):
    for a, b in zip(leaves(several), leaves(alone), strict=True):
        np.testing.assert_allclose(a[lane], b[0], rtol=rtol, atol=atol)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_makes_a_trainer(preset):
    make_trainer(envs.make("grid_world"), PRESETS[preset][0])


PAIRS = [
    name if bonus == "none" else f"{name}+{bonus}"
    for name, method in METHODS.items()
    for bonus in BONUSES
    if method.bonus == "none"
]
"""Every curriculum alone and with every bonus."""


def assert_makes_a_program(trainer):
    """Traced, not compiled: shapes and dtypes fit, the state keeps its structure, and nothing is done by the host."""
    hparams = jax.tree.map(jnp.float32, HParams())
    state = jax.eval_shape(trainer.init, jax.random.key(0), task_struct(trainer.space), hparams)
    traced = jax.jit(trainer.chunk).trace(state, Clock.start(), hparams)
    after, _, metrics = traced.out_info
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert "target_return" in metrics
    assert "callback" not in str(traced.jaxpr)
    return traced


@pytest.mark.parametrize("method", PAIRS)
def test_every_curriculum_and_bonus_make_a_program(method):
    assert_makes_a_program(make_trainer(SPACE, config(method)))


@pytest.mark.parametrize("space", ["grid_world", "manipulation"])
@pytest.mark.parametrize("method", ["apt_gen+rnd", "alp_gmm+ride", "goal_gan+icm", "random"])
def test_every_part_fits_every_space(method, space):
    """Every operation is one that accelerators have, too."""
    cfg = config(method, warmup_steps=1_000)
    traced = assert_makes_a_program(make_trainer(envs.make(space), cfg))
    traced.lower(lowering_platforms=("cuda", "tpu"))


def test_the_averaged_policy_is_judged():
    """Made to go right always, while the online network knows nothing and learns nothing."""
    hparams = [HParams(learning_rate=0.0, target_rate=0.0)] * 2
    states, clock, history = run(config("dqn"), [0, 1], hparams=hparams)
    assert np.all(history[-1]["target_return_raw"] < 0.0)
    averaged = jax.tree.map(jnp.zeros_like, states.learner.target_params)
    averaged["params"]["head"]["output"]["bias"] = jnp.tile(jnp.array([0.0, 1.0]), (2, 1))
    states = states._replace(learner=states.learner._replace(target_params=averaged))
    _, _, metrics = program(config("dqn"), 2, "map").chunk(states, clock, stack_hparams(hparams))
    assert np.all(metrics["target_return_raw"] > 0.5)


@pytest.mark.parametrize("method", [EVERYTHING, "random", "dqn", "alp_gmm", "goal_gan", "ride"])
def test_metrics_are_finite_and_the_clock_counts_every_source(method):
    _, hparams = PRESETS["fast"]
    lanes = 5 if method == EVERYTHING else 2
    _, clock, history = run(config(method), range(lanes), hparams=[hparams] * lanes)
    assert clock.env_steps == 180
    assert clock.iteration == (90 if parse_method(method).curriculum == "none" else 45)
    for metrics in history:
        for name, value in metrics.items():
            assert value.shape == (lanes + lanes % 2,), name  # two devices
            # Nothing is known of a source until an episode that began after the warm-up is over.
            assert np.isfinite(value).all() or name.startswith(("behaviour_", "generated_")), name


class Casting(Corridor):
    """Its observations begin with another dtype than its spec names."""

    def _observe(self, position, goal):
        return jax.tree.map(jnp.float32, super()._observe(position, goal))


class Paying(Corridor):
    """Its steps pay whole numbers."""

    def step(self, state, action, task):
        out = super().step(state, action, task)
        return out._replace(reward=out.reward.astype(jnp.int32))


def test_a_space_that_is_not_what_its_specs_say_is_refused():
    """The replay would cast in silence."""
    with pytest.raises(ValueError, match=r"corridor.reset must return observations like .*uint8.*, got .*float32"):
        make_trainer(Casting(), CONFIG)
    trainer = make_trainer(Paying(), CONFIG)
    with pytest.raises(ValueError, match=r"corridor.step must return a float32 reward, .*got .*int32"):
        jax.eval_shape(make_program(trainer, 1).warmup, *lane_struct(trainer))


@pytest.mark.relaxed("types")  # such a flag or state is what the protocol's types exclude
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda out: {"success": out.success.astype(jnp.int32)}, "corridor.step must return success as a bool"),
        (lambda out: {"truncated": out.truncated.astype(jnp.float32)}, "corridor.step must return truncated as a bool"),
        (lambda out: {"state": jax.tree.map(jnp.float32, out.state)}, "corridor.step must return a state like reset"),
    ],
)
def test_a_step_of_other_flags_or_states_is_refused(change, words):
    class Changing(Corridor):
        def step(self, state, action, task):
            out = super().step(state, action, task)
            return out._replace(**change(out))

    trainer = make_trainer(Changing(), CONFIG)
    with pytest.raises(ValueError, match=words):
        jax.eval_shape(make_program(trainer, 1).warmup, *lane_struct(trainer))


@pytest.mark.parametrize(
    ("attributes", "words"),
    [
        ({"num_actions": 0}, "num_actions must be in 1 to 256, got 0"),
        ({"horizon": 0}, "horizon must be at least 1, got 0"),
        ({"param_spec": {"noise": Vector(1, 0, 1)}}, "param_spec must name modalities like variables, .* got 'noise'"),
        ({"param_spec": {"a/b": Vector(1, 0, 1)}}, "param_spec must name .* got 'a/b'"),
        ({"obs_spec": {"tiles": Grid(2, 2, 2), "tiles_stack": Vector(1, 0, 1)}}, "none tiles_stack, got 'tiles_stack'"),
        (
            {"describe": lambda self, task, target: {"return": jnp.float32(0), "goal": jnp.float32(0)}},
            "to the trainer: return$",
        ),
        ({"describe": lambda self, task, target: {"spread_goal": jnp.float32(0)}}, "to the trainer: spread_goal$"),
    ],
)
def test_a_space_of_no_size_or_of_names_that_are_taken_is_refused(attributes, words):
    with pytest.raises(ValueError, match=words):
        make_trainer(type("Odd", (Corridor,), attributes)(), CONFIG)


@pytest.mark.relaxed("types")  # sizes that are not whole are what their type excludes
def test_sizes_that_are_not_whole_are_refused():
    for changes in ({"n_step": 1.5}, {"replay_steps": 200.0}):
        with pytest.raises(ValueError, match=f"{next(iter(changes))} must be a whole number, got"):
            make_trainer(SPACE, config("dqn", **changes))


def lane_struct(trainer):
    lanes = stack_hparams([HParams()])
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 1))
    return jax.eval_shape(make_program(trainer, 1).init, keys, targets(1), lanes), Clock.start(), lanes


def test_a_head_start_that_is_no_number_is_refused():
    for value in (math.nan, math.inf):
        with pytest.raises(ValueError, match=f"blank_bias must be finite, got {value}"):
            make_trainer(SPACE, config("apt_gen", blank_bias=value))


@pytest.mark.relaxed("types")  # such a layout is what its type excludes
def test_a_layout_or_devices_that_there_are_not_are_refused():
    trainer = make_trainer(SPACE, CONFIG)
    with pytest.raises(ValueError, match="layout must be one of auto, vmap, map, got 'pmap'"):
        make_program(trainer, 1, layout="pmap")
    with pytest.raises(ValueError, match="at least one device"):
        make_program(trainer, 1, devices=[])
    with pytest.raises(ValueError, match="resident must be at least 1 lane per device, got 0"):
        make_program(trainer, 3, resident=0)


def test_64_bits_are_refused():
    with jax.enable_x64(True), pytest.raises(ValueError, match="computes with 32 bits: unset jax_enable_x64"):
        make_trainer(SPACE, CONFIG)


def test_matmuls_are_whole_float32_whatever_the_platforms_default():
    trainer = make_trainer(SPACE, config("dqn"))
    state = jax.eval_shape(trainer.init, jax.random.key(0), TARGET, HParams())
    obs = jax.eval_shape(lambda: SPACE.reset(jax.random.key(0), TARGET)[1])
    text = jax.jit(trainer.act).lower(state.policy, obs=obs).as_text()
    assert text.count("dot_general") == text.count("precision = [HIGHEST, HIGHEST]") > 0


WEAK = {"position": Vector(1, 0, 1)}


def test_a_space_may_compute_with_weak_dtypes():
    class Weak(Corridor):
        obs_spec = WEAK

        def _observe(self, position, goal):
            return {"position": jnp.where(position == goal, 1.0, 0.0)[None]}

    make_trainer(Weak(), config("dqn"))


def test_a_vector_of_a_dtype_that_cannot_hold_it_is_refused():
    for dtype, words in (
        ("uint8", "holds low and high, 0 to 255"),
        ("float16", "float32 or whole numbers"),
        ("int64", "at most 32 bits"),
    ):
        with pytest.raises(ValueError, match=words):
            Vector(1, 0, 300, dtype)


def test_an_episode_is_truncated_at_the_horizon_by_a_space_that_forgets_to():
    class Endless(Corridor):
        def step(self, state, action, task):
            out = super().step(state, action, task)
            return out._replace(terminated=jnp.bool(False), truncated=jnp.bool(False))

    space = Endless()
    assignment = workers.assign(space, jnp.int32(8), None, 1)
    current, ends = workers.start(space, assignment, jax.random.key(0)), []
    for step in range(2 * space.horizon):
        action, key = jnp.zeros((1, 1), jnp.int32), jax.random.key(1 + step)
        current, transition, _, episode, done = workers.step(space, current, action, assignment, jnp.int32(step), key)
        assert not transition.terminated.any()
        assert (transition.done == done).all()
        ends += [int(episode.length[0, 0])] * bool(done[0, 0])
    assert ends == [space.horizon] * 2
    episode = episodes.play(space, jnp.int32(8), lambda obs, step: jnp.int32(1), jax.random.key(0))
    assert len(episode.actions) == len(episode.states) - 1 == space.horizon


def test_an_episode_is_a_success_if_any_of_its_steps_is():
    class Passing(Corridor):
        """Success does not end an episode."""

        def step(self, state, action, task):
            out = super().step(state, action, task)
            return out._replace(terminated=jnp.bool(False), truncated=out.state.steps >= self.horizon)

    space = Passing()
    current = workers.start(space, workers.assign(space, jnp.int32(1), None, 1), jax.random.key(0))
    flags = []
    for step in range(space.horizon):
        key = jax.random.key(1 + step)
        assignment = workers.assign(space, jnp.int32(1), None, 1)
        action = jnp.full((1, 1), step == 0, jnp.int32)  # one step to the goal, then back and against the wall
        current, _, _, episode, done = workers.step(space, current, action, assignment, jnp.int32(step), key)
        flags.append((bool(episode.success[0, 0]), bool(done[0, 0])))
    assert flags == [(True, False)] * (space.horizon - 1) + [(True, True)]
    assert not current.success.any()


def test_hparams_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\], got 1.5"):
        stack_hparams([HParams(), HParams(gamma=1.5)])


def test_every_hyper_parameter_has_a_range():
    assert list(ranges(HParams)) == [field.name for field in dataclasses.fields(HParams)]


def test_a_method_of_unknown_parts_is_refused(monkeypatch):
    monkeypatch.setitem(METHODS, "mine", Method("alp-gmm"))
    with pytest.raises(ValueError, match="unknown curriculum 'alp-gmm'; closest is 'alp_gmm'"):
        make_trainer(SPACE, config("mine"))


def test_a_target_of_another_shape_is_refused():
    compiled = program(config("dqn"), 1, "map")
    with pytest.raises(ValueError, match="must look like a task of corridor"):
        compiled.init(jax.random.split(jax.random.key(0), 1), np.zeros((1, 3), np.int32), stack_hparams([HParams()]))


def test_lanes_without_a_key_target_or_hparams_of_their_own_are_refused():
    compiled, keys, lanes = (
        program(config("dqn"), 2, "map"),
        jax.random.split(jax.random.key(0), 2),
        stack_hparams([HParams()] * 2),
    )
    in_turns = make_program(make_trainer(SPACE, config("dqn")), 2, resident=1, devices=jax.devices()[:1])
    for given in (
        (keys[:1], targets(2), lanes),
        (keys, targets(1), lanes),
        (keys, targets(3), lanes),
        (keys, targets(2), stack_hparams([HParams()])),
    ):
        for init in (compiled.init, in_turns.init, in_turns.init.lower):
            with pytest.raises(ValueError, match=r"a program of 2 lanes needs arrays \[2, ...\], got one of shape"):
                init(*given)


def test_diversity_sees_a_collapse_of_one_modality():
    spec = SPACE.param_spec
    w = jax.vmap(SPACE.sample_uniform)(jax.random.split(jax.random.key(0), 512))
    random = diversity(spec, w)
    np.testing.assert_allclose(random["probe_entropy_paint"], 1.0, atol=0.01)
    np.testing.assert_allclose(random["probe_spread_goal"], 12**-0.5, atol=0.02)
    collapsed = diversity(spec, {**w, "paint": jnp.broadcast_to(w["paint"][:1], w["paint"].shape)})
    np.testing.assert_allclose(collapsed["probe_entropy_paint"], 0.0, atol=1e-6)


@pytest.fixture
def smooth(monkeypatch):
    """No network has a kink: batched products round otherwise, and a ReLU at its kink makes another gradient of that.

    Of 20 seeds, one came to differ by 4e-3 within 90 updates.
    """
    monkeypatch.setattr(nn, "relu", nn.silu)
    monkeypatch.setitem(globals(), "program", functools.cache(program.__wrapped__))


def assert_seeds_alone_equal_themselves_among_others(layout):
    cfg, seeds = config(EVERYTHING), [3, 4, 5, 6, 7]
    several, _, history = run(cfg, seeds, layout=layout)
    # Metrics stay on the devices of their lanes: to bring them together, devices would have to wait for each other.
    assert all(value.sharding.spec == PartitionSpec("lane") for value in history[0].values())
    for lane, seed in enumerate(seeds):
        alone, _, _ = run(cfg, [seed])
        assert_lane_equal(several, lane, alone)


def test_a_seed_alone_equals_the_same_seed_among_others():
    """Float reassociation is the only difference allowed; on two devices five lanes also exercise the padding."""
    assert_seeds_alone_equal_themselves_among_others("map")


def test_a_seed_alone_equals_the_same_seed_of_a_batch(smooth):
    assert_seeds_alone_equal_themselves_among_others("vmap")


@pytest.mark.parametrize("layout", ["map", "vmap"])
@pytest.mark.parametrize("method", ["alp_gmm", "goal_gan", "ride"])
def test_a_seed_of_another_method_is_the_same_beside_any_other(method, layout):
    _, hparams = PRESETS["fast"]
    first, _, _ = run(config(method), [0, 1], layout=layout, hparams=[hparams] * 2)
    second, _, _ = run(config(method), [1, 2], hparams=[hparams] * 2)
    assert_lane_equal(first, 1, jax.tree.map(lambda x: x[:1], second))


def test_a_program_needs_lanes():
    with pytest.raises(ValueError, match="at least one lane, got 0"):
        make_program(make_trainer(SPACE, config("dqn")), 0)


class Device(NamedTuple):
    id: int
    process_index: int


@pytest.mark.relaxed("types")  # devices of other processes are made up
def test_fewer_lanes_than_devices_are_shared_by_all_processes():
    devices = [Device(i, process_index=i // 3) for i in range(6)]
    assert [device.process_index for device in _spread(devices, 3)] == [0, 0, 1]
    assert _spread(devices, 9) == devices
    with pytest.raises(ValueError, match=r"2 processes need at least a lane each .* got 1"):
        _spread(devices, 1)


def test_there_is_room_for_as_many_lanes_as_the_memory_holds_twice():
    trainer = make_trainer(SPACE, config("dqn"))
    state = jax.tree.leaves(jax.eval_shape(trainer.init, jax.random.key(0), TARGET, jax.tree.map(jnp.float32, HParams())))
    assert lane_bytes(trainer) == sum(leaf.size * leaf.dtype.itemsize for leaf in state)
    assert [room(trainer, memory) for memory in (1, 7 * lane_bytes(trainer))] == [1, 3]


def test_a_method_is_a_curriculum_and_a_bonus():
    assert parse_method("dqn") == Method("none", "none")
    assert parse_method("apt_gen+rnd") == Method("apt_gen", "rnd")
    assert parse_method("dqn+icm") == parse_method("icm")


def test_goal_gans_tasks_are_played_twice():
    """Consecutive episodes of an environment share their task, and then it changes."""
    states, _, _ = run(config("goal_gan"), [0, 1], chunks=4)
    count = int(states.replay.finished[0, 1])
    episodes = jax.tree.map(lambda x: np.asarray(x[0, 1, :count]), states.replay.episodes)
    for env in range(2):
        goals = episodes.w["goal"][episodes.env == env, 0]
        assert len(goals) >= 4
        np.testing.assert_array_equal(goals[0 : len(goals) // 2 * 2 : 2], goals[1 : len(goals) // 2 * 2 : 2])
        assert (goals[2::2] != goals[1:-1:2]).all()


def test_a_bonus_widens_the_clip_to_its_own_returns():
    """RIDE's scale is large: what is trained on is worth more than the environment pays, and bounds the next values."""
    states, _, _ = run(config("ride"), [0, 1], hparams=[HParams(ride_scale=10.0)] * 2)
    assert states.bonus.stream.highest[0] > 1.0 >= states.replay.returns.high[0]
    assert states.replay.transitions.note.shape == states.replay.transitions.reward.shape


def test_hyper_parameter_lanes_equal_separate_runs():
    cfg = config(EVERYTHING)
    lanes = [HParams(delta=delta, gamma=gamma) for delta, gamma in ((0.1, 0.9), (0.9, 0.5), (0.1, 0.5), (0.5, 0.9), (0.9, 0.0))]
    several, _, _ = run(cfg, [1] * 5, hparams=lanes, layout="vmap")
    for lane, hparams in enumerate(lanes):
        alone, _, _ = run(cfg, [1], hparams=[hparams])
        assert_lane_equal(several, lane, alone)
    first, second = (leaves(jax.tree.map(lambda x, i=i: x[i], several.learner.params)) for i in (0, 1))
    assert any(not np.allclose(a, b) for a, b in zip(first, second, strict=True))


def test_lanes_may_have_targets_of_their_own():
    both, _, _ = run(config("dqn"), [0, 1], goals=[TARGET, np.int32(3)])
    near, _, history = run(config("dqn"), [2, 1], goals=[np.int32(3)] * 2)
    assert np.asarray(both.target).tolist() == [TARGET, 3]
    assert_lane_equal(both, 1, jax.tree.map(lambda x: x[1:], near))
    assert history[-1]["behaviour_success"][1] > 0


def test_seeds_differ():
    states, _, _ = run(config("random"), [0, 1], chunks=1)
    kernels = leaves(states.learner.params)
    assert all(not np.array_equal(k[0], k[1]) for k in kernels)


@pytest.mark.parametrize("method", [EVERYTHING, "alp_gmm", "goal_gan", "ride"])
def test_nothing_compiles_after_the_first_chunk(method):
    """Neither in a longer run, nor for other seeds or hyper-parameters."""
    cfg = config(method)
    lanes = 5 if method == EVERYTHING else 2  # programs of other tests
    run(cfg, range(lanes), chunks=1)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **_: compiled.append(event) if "backend_compile" in event else None
    )
    run(cfg, range(5, 5 + lanes), chunks=3, hparams=[HParams(delta=0.3), *[HParams(gamma=0.5)] * (lanes - 1)])
    assert not compiled
    jax.jit(lambda x: x + 1.5)(np.float32(2.0))
    assert compiled, "the listener must hear a compilation"


def test_states_are_donated():
    compiled = program(config("random"), 2, "map")
    lanes = stack_hparams([HParams()] * 2)
    states = compiled.init(jax.random.split(jax.random.key(0), 2), targets(2), lanes)
    compiled.warmup(states, Clock.start(), lanes)
    assert states.replay.transitions.reward.is_deleted()


def test_evaluating_more_often_changes_nothing_in_training():
    slow = [HParams(learning_rate=1e-5)] * 2
    often, _, history = run(config("random"), [2, 3], chunks=4, hparams=slow)
    seldom, _, _ = run(config("random", eval_every=4 * CONFIG.eval_every), [2, 3], chunks=1, hparams=slow)
    # A restore would be such a change by intent, and needs a target that is solved.
    assert not np.any([metrics["restored"] for metrics in history])
    for a, b in zip(leaves(often.replay), leaves(seldom.replay), strict=True):
        np.testing.assert_array_equal(a, b)


def lanes_equal(one, other):
    """Of two lanes, whether all leaves are the same."""
    pairs = list(zip(leaves(one), leaves(other), strict=True))
    return [all(np.array_equal(a[lane], b[lane]) for a, b in pairs) for lane in (0, 1)]


def test_an_unsolved_run_resets_its_q_function_and_nothing_else():
    slow = HParams(learning_rate=1e-5)
    states, _, history = run(config("random"), [2, 2], hparams=[slow, slow.replace(reset_every=2.0 * CONFIG.eval_every)])
    assert (states.kept.score < 0).all(), "the target must be unsolved"
    assert [metrics["reset"].tolist() for metrics in history] == [[0, 0], [0, 1]]
    assert jax.vmap(has_learned)(states.learner.opt_state).tolist() == [True, False]
    for leaf in leaves((states.replay, states.workers, states.kept)):
        np.testing.assert_array_equal(leaf[0], leaf[1])
    assert lanes_equal(states.policy, states.learner.target_params) == [True, False]


def test_target_source_plays_only_the_target_and_the_generated_source_its_w():
    states, _, _ = run(config("random"), [0, 1])
    assert (np.asarray(states.workers.task)[0, 0] == TARGET).all()
    w = jax.tree.map(lambda x: x[0, 1], states.workers.w)
    np.testing.assert_array_equal(states.workers.task[0, 1], jax.vmap(SPACE.instantiate)(w))


def test_the_final_observation_is_stored_not_the_reset_one():
    states, _, _ = run(config("random"), [0, 1])
    steps = jax.tree.map(lambda x: np.asarray(x[0]).reshape(-1, *x.shape[4:]), states.replay.transitions)
    ended = steps.terminated & (steps.reward > 0)
    assert ended.any()
    assert (steps.next_obs["offset"][ended] == 0).all()


@pytest.mark.parametrize("method", ["apt_gen", "random", "dqn"])
def test_methods_learn_a_shorter_corridor(method):
    """The paper's form, five tiles away: the shortest way pays 0.96, and nothing else more than 0.94."""
    paper = {name: PAPER[name] for name in SWITCHES}
    sizes = {"warmup_steps": 400, "updates_per_step": 2, "batch_size": 64, "replay_steps": 2000}
    cfg = config(method, **paper, **sizes, refresh_every=100, eval_every=400)
    compiled = make_program(make_trainer(SPACE, cfg), 2)
    lanes = stack_hparams([HParams(learning_rate=1e-3, epsilon_steps=400.0)] * 2)
    states = compiled.init(jax.vmap(jax.random.key)(np.arange(2)), np.full(2, 5, np.int32), lanes)
    states, clock = compiled.warmup(states, Clock.start(), lanes)
    for _ in range(8):
        states, clock, metrics = compiled.chunk(states, clock, lanes)
    np.testing.assert_allclose(metrics["target_return_raw"], 0.96, atol=1e-5)


@pytest.fixture(scope="module")
def saved_between_chunks(tmp_path_factory):
    """The end of a run of three chunks that saves nothing, and another's checkpoint before each chunk."""
    path = tmp_path_factory.mktemp("checkpoints")
    straight, straight_clock, _ = run(config(EVERYTHING), range(5), chunks=3)
    states, clock, _ = run(config(EVERYTHING), range(5), chunks=0)
    for chunk in range(3):
        if chunk:
            states, clock, _ = program(config(EVERYTHING), 5, "map").chunk(states, clock, stack_hparams([HParams()] * 5))
        checkpoint.save(path / str(chunk), int(clock.env_steps), (states, clock))
    return straight, straight_clock, path


@pytest.mark.parametrize("stop", [0, 1, 2])
def test_resuming_from_a_checkpoint_equals_never_having_stopped(saved_between_chunks, stop):
    """Bit for bit, in every leaf of the state, whichever chunk was the last before the stop."""
    *straight, path = saved_between_chunks
    states, clock = checkpoint.restore(path / str(stop), tuple(straight))
    for _ in range(3 - stop):
        states, clock, _ = program(config(EVERYTHING), 5, "map").chunk(states, clock, stack_hparams([HParams()] * 5))
    for a, b in zip(leaves((states, clock)), leaves(straight), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"method": "apt-gen"}, "unknown method 'apt-gen'; closest is 'apt_gen'"),
        ({"method": "rnd+icm"}, "has two bonuses"),
        ({"method": "dqn+rdn"}, "unknown bonus 'rdn'; closest is 'rnd'"),
        ({"method": "rnd", "n_step": 2}, "n_step must be 1 with the bonus 'rnd'"),
        ({"batch_size": 15}, "batch_size .* 2 sources, got 15"),
        ({"eval_every": 44}, "eval_every must be a multiple of refresh_every=20, got 44"),
        ({"eval_every": 50}, "eval_every .* multiple of 4, the environment steps of one iteration"),
        ({"recent_steps": 20}, "recent_steps .* at least 24, got 20"),
        ({"model_batch_size": 1}, "model_batch_size must be at least 2 .* got 1"),
        ({"model_batch_size": 3}, "multiple of the 2 sources, got 3"),
        ({"replay_episodes": 5}, "replay_episodes .* return_window=10"),
        ({"refresh_every": 18}, "refresh_every .* multiple of 4, the environment steps of one iteration"),
        ({"warmup_steps": 40}, "warmup_steps .* at least 48, got 40"),
        ({"model_updates_per_step": 0.3}, "whole number of updates"),
        ({"replay_steps": 100}, "replay_steps .* at least 124"),
        ({"success_share": 1.5}, "success_share must lie in"),
        ({"success_share": 0.01}, "at least one of 8 transitions, got 0.01"),
        ({"envs_per_source": 0}, "envs_per_source"),
        ({"eval_episodes": 0}, "eval_episodes must be at least 1"),
    ],
)
def test_sizes_that_do_not_fit_are_named(changes, words):
    with pytest.raises(ValueError, match=words):
        make_trainer(SPACE, dataclasses.replace(CONFIG, **changes))
