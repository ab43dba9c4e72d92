"""The paper's target tasks as layouts, read off the pictures on the authors' project page."""

from __future__ import annotations

TARGETS = {
    "A": """
A.......
........
........
.....###
.....#..
LLL..Y..
.....#G.
y....#..
""",
    "B": """
A....YG.
.....#..
.....#..
.....###
........
B##.....
.y#...b.
..#.....
""",
    "C": """
A...#.Ly
......L.
........
....#...
#####LYL
...L....
.G.B..LL
...L...b
""",
}
"""Layout of each target by name; the shortest solutions take 22, 36 and 29 steps."""
