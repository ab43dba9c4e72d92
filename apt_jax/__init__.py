"""A JAX-native, vectorised, end-to-end trainer for APT-Gen."""

from apt_jax.config import PRESETS, Config, HParams
from apt_jax.lanes import Program, make_program, stack_hparams, stack_targets
from apt_jax.specs import Grid, Table, Vector
from apt_jax.task_space import StepOutput, TaskSpace
from apt_jax.trainer import Clock, Trainer, TrainState, make_trainer

__all__ = [
    "PRESETS",
    "Clock",
    "Config",
    "Grid",
    "HParams",
    "Program",
    "StepOutput",
    "Table",
    "TaskSpace",
    "TrainState",
    "Trainer",
    "Vector",
    "make_program",
    "make_trainer",
    "stack_hparams",
    "stack_targets",
]
