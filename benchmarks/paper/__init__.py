"""The paper, reproduced: its figures and tables from a simulated rig, with the product's own path.

Every part simulates a machine, sends its samples as CAN frames, learns from the frames what the
product learns, and lays the result beside the paper's; `benchmarks.paper.parts` lists them.
"""
