"""The falling bar, whose motion is known exactly, on meshes of any size."""

import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

END = 2.0
BAR = jc.reference.FallingBar()


def build(h):
    """The scene with cells of length h"""
    return jc.Scene(
        mesh=jc.meshes.interval(BAR.length, h=h),
        material=jc.KelvinVoigt(young=BAR.young, poisson=0.0),
        contact={"left": jc.HalfSpace(point=[-BAR.gap], normal=[1.0])},
        body_force=[-BAR.gravity],
    )


def mean_height(stepper):
    """Mean displacement over the bar and over the time, and the motion"""
    motion = jc.simulate(stepper, steps=round(END / float(stepper.dt)))
    return jnp.mean(motion.displacement), motion


def exact_mean():
    """What it is exactly"""
    x, t = np.linspace(0.0, BAR.length, 401), np.linspace(0.0, END, 801)
    return float(jnp.mean(BAR.displacement(x[None, :], t[:, None])))
