"""The paper's target tasks as text, read off the pictures on the authors' project page, and one that lies outside the space.

Lengths were measured to 1.5 cm.  The cans of A and C are as measured; the goal is the space's, near which it stands in all
pictures.  In B the target is 0.5 cm further right and 0.6 cm closer to the robot: from the measured place the search finds no
push sequence that ends within the goal wherever its centre is drawn.

The paper shows its out-of-space task (a table of another shape with a laptop, a lamp, a clock and books) in one small
picture; this one is made in its likeness.
"""

from __future__ import annotations

TARGETS = {
    "A": """
F...FF
FFFFFF
FFFFFF
F...FF
can 13.8 31.3
can 36.9 37.2
can 57.2 22.1
range 10
""",
    "B": """
FF.###
FF.#F#
FFFFF.
FF.FF.
can 25.0 4.3
can 21.3 33.2
can 54.0 39.5
range 10
""",
    "C": """
F...##
FFFFF#
FF..#.
FFFF##
can 15.3 21.0
can 45.5 27.8
can 14.7 37.1
range 10
""",
    "out_of_space": """
......FFFFFFFFFFFFFFFFFFFFFFFF......
....FFFFFFFFFFFFFFFFFFFFFFFFFFFF....
...FFFFFFFFFFFFFFFFFFFFFFFFFFFFFF...
..FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF..
.FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF.
.FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF.
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
FFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF
.FFFFFFFFFFFFFF..FFFFFFFFFFFFFFFFFF.
.FFFFFFFFFFF........FFFFFFFFFFFFFFF.
..FFFFFFFFFF..........FFFFFFFFFFFF..
...FFFFFFFF............FFFFFFFFFF...
....FFFFFF.............FFFFFFFFF....
......FFFF..............FFFFFF......
box 39 17 27 19 20 6
cylinder 77 46 6 30
cylinder 59 6 5 12
box 13 50 18 12 8 -20
can 14 24.5
can 34.5 37.5
can 64 30
range 10
""",
}

DEMONSTRATIONS = {
    "A": (0, 3, 0, 0, 9, 0, 0),
    "B": (1, 6, 1, 1, 0, 9, 0, 0, 0, 3),
    "C": (6, 6, 5, 0, 0, 0, 0, 0),
    "out_of_space": (1, 4, 0, 4, 0, 0, 5, 0, 11, 0, 8, 3),
}
"""Actions of the solution of each target that `solver.solve` finds; they succeed wherever the goal's centre is drawn."""
