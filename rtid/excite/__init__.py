"""Experiment design: the motion that identifies a machine, and what it will tell, in advance.

limits      what the motion may do
machine     the nominal machine, and the paper's sweep
driving     its closed loop as one kernel
library     candidate segments, each from rest to rest at one place
information what each segment tells of the blocks and of the effects
selection   segments that are worth their time: greedy, D-optimal
prediction  standard errors and detection limits of a whole motion
design      all of it
"""
