"""`make bench`: how fast offbench is, each row a ratio of two sides that took turns on the same machine.

side.py        a side: a process that does its work for so many seconds when told to, and says how much it did
sides.py       offbench's sides, and those of Stable-Baselines3, Minari, MuJoCo and plain matrix products
d3rlpy_peer.py, jax_peer.py
               d3rlpy's and JAX's sides, run in an environment of their own (offbench is not imported there)
arithmetic.py  the matrix products of an update, counted by hand
rows.py        which sides make which row, and what is expected
gpu.py         a stack on a GPU against one run, in slices that resume
profile.py     where the time goes, of what misses its target
__main__.py    runs the rows and writes docs/benchmarks-KIND.md, KIND the processor's vector instructions
"""
