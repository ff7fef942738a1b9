"""The parts of the build that pyproject.toml cannot say: the C extensions, and where numpy's headers are."""

import numpy
from setuptools import Extension, setup

setup(
    ext_modules=[
        Extension(
            "touchcell.geometry._se3c",
            sources=["touchcell/geometry/_se3c.c"],
            depends=["touchcell/geometry/_se3_kernels.h", "touchcell/geometry/_gaussian_kernels.h"],
            include_dirs=[numpy.get_include()],
            # Contracted multiply-adds would make results depend on the machine.
            extra_compile_args=["-O3", "-ffp-contract=off"],
            # Without a compiler the plain kernels serve.
            optional=True,
        ),
        Extension(
            "touchcell.control.interlocks._distances",
            sources=["touchcell/control/interlocks/_distances.c"],
            include_dirs=[numpy.get_include()],
            extra_compile_args=["-O3", "-ffp-contract=off"],
            # Without a compiler distances are computed in NumPy.
            optional=True,
        ),
        Extension(
            "touchcell.drivers.v4l2._jpegc",
            sources=["touchcell/drivers/v4l2/_jpegc.c"],
            extra_compile_args=["-O3"],
            # Without a compiler only the markers of JPEG frames are checked.
            optional=True,
        ),
        Extension(
            "touchcell.perception._kernelsc",
            sources=["touchcell/perception/_kernelsc.c"],
            depends=[
                "touchcell/perception/_image_kernels.h",
                "touchcell/perception/_matching_kernels.h",
            ],
            # The median of 5x5 pixels takes a sixth longer where a change elsewhere moves it across a cache line.
            extra_compile_args=["-O3", "-ffp-contract=off", "-falign-functions=64"],
            # Without a compiler image networks serve, and marker estimators say what is missing.
            optional=True,
        ),
        Extension(
            "touchcell.simulation._paint",
            sources=["touchcell/simulation/_paint.c"],
            include_dirs=[numpy.get_include()],
            extra_compile_args=["-O3"],
            optional=True,
        ),
        Extension(
            "touchcell.simulation.meshes._mesh",
            sources=["touchcell/simulation/meshes/_mesh.c"],
            include_dirs=[numpy.get_include()],
            extra_compile_args=["-O3", "-ffp-contract=off"],
            # Without a compiler every face is compared with every point, in NumPy.
            optional=True,
        ),
    ]
)
