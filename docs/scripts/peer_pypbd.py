"""Times pypbd's shape matching on a package's particles and clusters: 3 substeps of 9 iterations a step, no contacts.

Usage: peer_pypbd.py PACKAGE [STEPS]. Needs pypbd and numpy. Prints counts and milliseconds a step.
"""
import io
import sys
import time
import zipfile

import numpy as np
import pypbd as pbd

archive = zipfile.ZipFile(sys.argv[1])
steps = int(sys.argv[2]) if len(sys.argv) > 2 else 60
load = lambda name: np.load(io.BytesIO(archive.read(name + ".npy")))
x = load("particles/positions").astype(float)
offsets, members = load("clusters/offsets"), load("clusters/members")
counts = np.bincount(members, minlength=len(x))

sim = pbd.Simulation.getCurrent()
sim.initDefault()
model = sim.getModel()
particles = model.getParticles()
for p in x:
    particles.addVertex(p)
for i in range(len(x)):
    particles.setMass(i, 1.0)
for a, b in zip(offsets[:-1], offsets[1:]):
    ids = members[a:b].astype(int).tolist()
    model.addShapeMatchingConstraint(len(ids), ids, counts[members[a:b]].astype(int).tolist(), 0.35)
step = sim.getTimeStep()
step.setValueUInt(pbd.TimeStepController.NUM_SUB_STEPS, 3)
step.setValueUInt(pbd.TimeStepController.MAX_ITERATIONS, 9)
pbd.TimeManager.getCurrent().setTimeStepSize(1 / 60)
step.step(model)
times = []
for _ in range(steps):
    t = time.perf_counter()
    step.step(model)
    times.append(1e3 * (time.perf_counter() - t))
y = np.array([particles.getPosition(i) for i in range(len(x))])
assert np.isfinite(y).all()
d = y - x
print(f"pypbd: {len(x)} particles, {len(offsets) - 1} clusters, {len(members)} memberships: "
      f"min {min(times):.2f}, mean {np.mean(times):.2f} ms a step; spread of displacement {np.ptp(d, axis=0)}")
