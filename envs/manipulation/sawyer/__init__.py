"""Manipulation by a Sawyer arm.

`replay` plays episodes in MuJoCo, with every shape and contact as it is, and `film` films them; `simulation` has the arm push
in MJX, as part of the task space.  Both have the robot from `arm`.

What the robot sees: it stands at y < 0 and looks along y, so x runs to its right.  A task's x runs to the right of someone who
faces the robot; `stage.mirror` takes one to the other, and everything below it is as the robot sees it.
"""
