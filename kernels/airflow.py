"""Airflow in a hall on a grid of cells: transport coefficients, and BiCGSTAB for linear systems.

Cells that hold air have the numbers 0..N-1. Index N stands for "no cell"; its unknown stays zero.
The faces of a cell are numbered -x, -y, -z, +x, +y, +z; the neighbours beyond the first three
have lower numbers than the cell. The matrix A of a system has ``diagonal`` on its diagonal. In the
column of the cell beyond each face it has -``off_diagonal``, which is at most 0. With
``through_racks``, air also passes through the racks: the air that leaves a back face carries the
mean of the unknown over the front of its rack, times the airflow of the face.

The solver of one system A x = b is the preconditioned, stabilised biconjugate gradient method (van
der Vorst 1992, SIAM J. Sci. Stat. Comput. 13(2)). Each line names its function on the right:

    x <- 0                                                          solve_right_side
    repeat, at most MOST_STARTS times:
        r <- b - A x;  r^ <- r;  p <- r;  rho <- (r^, r)            start_iterations
        if |r| <= tolerance |b|: done
        repeat until |r| <= tolerance |b|, or a divisor is 0:       iterate
            y <- K^-1 p;  v <- A y                                  precondition, multiply
            alpha <- rho / (r^, v)
            x <- x + alpha y;  r <- r - alpha v                     advance
            z <- K^-1 r;  t <- A z                                  precondition, multiply
            omega <- (t, r) / (t, t)
            x <- x + omega z;  r <- r - omega t                     advance
            beta <- (r^, r) / rho * alpha / omega;  rho <- (r^, r)
            p <- r + beta (p - omega v)                             update_search_direction

K = (D + L) D^-1 (D + U) is the diagonal incomplete LU factorisation (Pommerell 1992, dissertation,
ETH Zurich). L and U are the parts of A below and above its diagonal, without the terms of racks.
Iterations update r instead of computing it anew, so r drifts from b - A x. The solver therefore
restarts several times, each time from the x found so far. All starts together do at most
``most_iterations`` iterations.

One thread solves each right side, so the number of threads does not change any bit of the result.
"""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .arguments import Argument
from .compiler.functions import part_of
from .compiler.named_kernel import define_kernel

WORK_VECTORS = 9
"""Work vectors of N + 1 numbers per thread."""

(
    _SOLUTION,  # x
    _RESIDUAL,  # r
    _SHADOW_RESIDUAL,  # r^
    _SEARCH_DIRECTION,  # p
    _A_DIRECTION,  # v = A y
    _A_CORRECTION,  # t = A z
    _DIRECTION,  # y = K^-1 p
    _CORRECTION,  # z = K^-1 r
    _INVERSE_PIVOT,  # 1 / D
) = range(WORK_VECTORS)

MOST_STARTS = 20
"""Maximum number of starts for a right side, including the first."""

SYSTEM_ARGUMENTS = {
    "serial": Argument("template"),  # True: run on the calling thread alone
    "through_racks": Argument("template"),  # True if air passes through the racks
    "slices": Argument("i32"),  # number of parts of the right sides, one thread each
    "most_iterations": Argument("i32"),  # maximum number of iterations for one right side
    "tolerance": Argument("f64"),  # |r| / |b| at which a system counts as solved
    # The matrix.
    "beyond": Argument("i32", 2),  # cell beyond each face, N for no cell, (N + 1, 6)
    "off_diagonal": Argument("f64", 2),  # coefficient of the cell beyond, at least 0, (N + 1, 6)
    "diagonal": Argument("f64", 1),  # coefficient of the cell itself, (N,)
    "front_offsets": Argument("i32", 1),  # first front face of each rack, then the end, (R + 1,)
    "front_cell": Argument("i32", 1),  # cell before each front face
    "front_share": Argument("f64", 1),  # share of its rack's airflow, for each front face
    "back_offsets": Argument("i32", 1),  # first back face of each rack, then the end, (R + 1,)
    "back_cell": Argument("i32", 1),  # cell before each back face
    "back_m3s": Argument("f64", 1),  # airflow out of each back face, m3/s
    # The right sides.
    "source_offsets": Argument("i32", 1),  # first source of each right side, then the end, (T + 1,)
    "source_cell": Argument("i32", 1),  # cell of each source
    "source": Argument("f64", 1),  # amount that each source adds to the right side
    # Work space.
    "work": Argument("f64", 3),  # (slices, WORK_VECTORS, N + 1)
    # Results, and the return openings at which the solutions are evaluated.
    "return_cell": Argument("i32", 1),  # cell before each return face
    "return_m3s": Argument("f64", 1),  # flow out of each return face, m3/s
    "first_solution": Argument("f64", 1),  # solution of the first right side, (N + 1,)
    "intake": Argument("f64", 2),  # mean solution over the front of each rack, (R, T)
    "returned": Argument("f64", 1),  # flow times solution, summed over the returns, (T,)
    "relative_residual": Argument("f64", 1),  # |r| / |b|, 0 where b is 0, (T,)
    "iterations": Argument("i32", 1),  # number of iterations, (T,)
}
"""Arguments of the kernel of ``bicgstab_kernel`` by name, template arguments first."""


@cache
def transport_kernel() -> Any:
    """Return the kernel that turns a flow potential into face flows and transport coefficients.

    Flow through a face is its conductance times the drop in potential. A tag (passive scalar) c
    crosses the face at the rate q*(c_P + c_N)/2 + G*(c_P - c_N), with flow q and
    G = max(mixing*speed*conductance, |q|/2). This is the hybrid scheme (Spalding 1972,
    International Journal for Numerical Methods in Engineering 4(4)): central differences where the
    mixing keeps them bounded, upwind differences elsewhere. ``speed`` is the mean of both cells.

    Arguments of the kernel:

    - beyond: cell beyond each face, N for no cell, (N + 1, 6).
    - conductance_m: free area of each face divided by the distance of the two cell centres, in m,
      (N + 1, 6).
    - boundary_m3s: flow that leaves the hall through each face, m3/s, (N + 1, 6).
    - area_m2: area of the faces across each axis, m2, (N + 1, 3).
    - mixing_m: eddy diffusivity divided by air speed, in m.
    - potential_m2s: potential of the flow, m2/s, (N + 1,).
    - speed_ms: output, air speed in m/s; the last entry stays 0, (N + 1,).
    - imbalance_m3s: output, net flow out of each cell in m3/s, 0 up to rounding, (N,).
    - off_diagonal: output, coefficients of the cells beyond the faces, m3/s, (N + 1, 6).
    - diagonal: output, coefficients of the cells themselves, m3/s, (N,).
    """
    reals_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)
    reals_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)

    @ti.kernel
    @no_type_check
    def set_transport(
        beyond: ints_2d,
        conductance_m: reals_2d,
        boundary_m3s: reals_2d,
        area_m2: reals_2d,
        mixing_m: ti.f64,
        potential_m2s: reals_1d,
        speed_ms: reals_1d,
        imbalance_m3s: reals_1d,
        off_diagonal: reals_2d,
        diagonal: reals_1d,
    ):
        for c in range(diagonal.shape[0]):
            leaving_m3s = ti.cast(0.0, ti.f64)
            speed_squared = ti.cast(0.0, ti.f64)
            for axis in range(3):
                low_m3s = boundary_m3s[c, axis] + conductance_m[c, axis] * (
                    potential_m2s[c] - potential_m2s[beyond[c, axis]]
                )
                high_m3s = boundary_m3s[c, axis + 3] + conductance_m[c, axis + 3] * (
                    potential_m2s[c] - potential_m2s[beyond[c, axis + 3]]
                )
                leaving_m3s += low_m3s + high_m3s
                velocity_ms = (high_m3s - low_m3s) / (2.0 * area_m2[c, axis])
                speed_squared += velocity_ms * velocity_ms
            imbalance_m3s[c] = leaving_m3s
            speed_ms[c] = ti.sqrt(speed_squared)
        for c in range(diagonal.shape[0]):
            total = ti.cast(0.0, ti.f64)
            for face in range(6):
                n = beyond[c, face]
                q = conductance_m[c, face] * (potential_m2s[c] - potential_m2s[n])
                G = ti.max(
                    0.5 * mixing_m * (speed_ms[c] + speed_ms[n]) * conductance_m[c, face],
                    0.5 * ti.abs(q),
                )
                off_diagonal[c, face] = G - 0.5 * q
                total += G + 0.5 * q + ti.max(boundary_m3s[c, face], 0.0)
            diagonal[c] = total

    return set_transport


@cache
def bicgstab_kernel() -> Any:
    """Return the kernel that solves the linear system for every right side by BiCGSTAB.

    The module docstring gives the algorithm. SYSTEM_ARGUMENTS lists the arguments of the kernel.
    """
    return define_kernel("solve_systems", SYSTEM_ARGUMENTS, run_slice, precision="f64")


@ti.func
@no_type_check
def run_slice(system: ti.template(), s):
    """Solve the right sides of slice ``s``, with ``work[s]`` as work space."""
    no_cell = system.diagonal.shape[0]
    for vector in range(system.work.shape[1]):
        system.work[s, vector, no_cell] = 0.0
    factorise(system, s)
    first, end = part_of(s, system.slices, system.relative_residual.shape[0])
    for rhs in range(first, end):
        solve_right_side(system, s, rhs)
        store_results(system, s, rhs)


@ti.func
@no_type_check
def factorise(system: ti.template(), s):
    """Compute 1 / D: D_c = A_cc - sum of A_cb A_bc / D_b over the lower neighbours b of cell c."""
    cells = system.diagonal.shape[0]
    for c in range(cells):
        pivot = system.diagonal[c]
        for face in range(3):
            b = system.beyond[c, face]
            if b < cells:
                pivot -= (
                    system.off_diagonal[c, face]
                    * system.off_diagonal[b, face + 3]
                    * system.work[s, _INVERSE_PIVOT, b]
                )
        system.work[s, _INVERSE_PIVOT, c] = 1.0 / pivot


@ti.func
@no_type_check
def precondition(system: ti.template(), s, vector, out):
    """Set ``out`` to K^-1 times a work vector: solve D + L forwards, then I + D^-1 U backwards."""
    cells = system.diagonal.shape[0]
    for c in range(cells):
        total = system.work[s, vector, c]
        for face in ti.static(range(3)):
            total += system.off_diagonal[c, face] * system.work[s, out, system.beyond[c, face]]
        system.work[s, out, c] = total * system.work[s, _INVERSE_PIVOT, c]
    for i in range(cells):
        c = cells - 1 - i
        total = ti.cast(0.0, ti.f64)
        for face in ti.static(range(3, 6)):
            total += system.off_diagonal[c, face] * system.work[s, out, system.beyond[c, face]]
        system.work[s, out, c] += total * system.work[s, _INVERSE_PIVOT, c]


@ti.func
@no_type_check
def multiply(system: ti.template(), s, vector, out):
    """Set ``out`` to A times a work vector."""
    for c in range(system.diagonal.shape[0]):
        total = system.diagonal[c] * system.work[s, vector, c]
        for face in ti.static(range(6)):
            total -= system.off_diagonal[c, face] * system.work[s, vector, system.beyond[c, face]]
        system.work[s, out, c] = total
    if ti.static(system.through_racks):
        for rack in range(system.front_offsets.shape[0] - 1):
            mean = front_mean(system, s, vector, rack)
            for i in range(system.back_offsets[rack], system.back_offsets[rack + 1]):
                system.work[s, out, system.back_cell[i]] -= system.back_m3s[i] * mean


@ti.func
@no_type_check
def front_mean(system: ti.template(), s, vector, rack):
    """Return the mean of a work vector over the front of a rack, weighted by airflow."""
    mean = ti.cast(0.0, ti.f64)
    for i in range(system.front_offsets[rack], system.front_offsets[rack + 1]):
        mean += system.front_share[i] * system.work[s, vector, system.front_cell[i]]
    return mean


@ti.func
@no_type_check
def dot(system: ti.template(), s, a, b):
    """Return the scalar product of two work vectors."""
    total = ti.cast(0.0, ti.f64)
    for c in range(system.diagonal.shape[0]):
        total += system.work[s, a, c] * system.work[s, b, c]
    return total


@ti.func
@no_type_check
def load_right_side(system: ti.template(), s, rhs, out):
    """Set ``out`` to right side ``rhs``."""
    for c in range(system.diagonal.shape[0]):
        system.work[s, out, c] = 0.0
    for i in range(system.source_offsets[rhs], system.source_offsets[rhs + 1]):
        system.work[s, out, system.source_cell[i]] += system.source[i]


@ti.func
@no_type_check
def solve_right_side(system: ti.template(), s, rhs):
    """Solve for right side ``rhs``; store the number of iterations and the relative residual."""
    for c in range(system.diagonal.shape[0]):
        system.work[s, _SOLUTION, c] = 0.0
    load_right_side(system, s, rhs, _RESIDUAL)
    goal = system.tolerance * ti.sqrt(dot(system, s, _RESIDUAL, _RESIDUAL))
    residual_norm = ti.cast(0.0, ti.f64)
    iterations, starts, ends = 0, 0, False
    while starts < MOST_STARTS and not ends:
        starts += 1
        rho = start_iterations(system, s, rhs)
        residual_norm = ti.sqrt(rho)
        ends = residual_norm <= goal or iterations >= system.most_iterations
        if not ends:
            residual_norm, iterations = iterate(system, s, rho, goal, iterations)
    system.relative_residual[rhs] = 0.0
    if goal > 0.0:
        system.relative_residual[rhs] = system.tolerance * residual_norm / goal
    system.iterations[rhs] = iterations


@ti.func
@no_type_check
def start_iterations(system: ti.template(), s, rhs):
    """Set r, r^ and p to b - A x, and return rho."""
    load_right_side(system, s, rhs, _RESIDUAL)
    multiply(system, s, _SOLUTION, _A_DIRECTION)
    for c in range(system.diagonal.shape[0]):
        residual = system.work[s, _RESIDUAL, c] - system.work[s, _A_DIRECTION, c]
        system.work[s, _RESIDUAL, c] = residual
        system.work[s, _SHADOW_RESIDUAL, c] = residual
        system.work[s, _SEARCH_DIRECTION, c] = residual
    return dot(system, s, _RESIDUAL, _RESIDUAL)


@ti.func
@no_type_check
def iterate(system: ti.template(), s, rho_at_start, goal, iterations_before):
    """Iterate until |r| reaches the goal, iterations are used up, or a divisor is 0.

    Returns:
        |r|, and the number of iterations since the first start.
    """
    rho, iterations = rho_at_start, iterations_before
    residual_norm = ti.sqrt(rho)
    ends = False
    while not ends:
        iterations += 1
        precondition(system, s, _SEARCH_DIRECTION, _DIRECTION)
        multiply(system, s, _DIRECTION, _A_DIRECTION)
        shadow_product = dot(system, s, _SHADOW_RESIDUAL, _A_DIRECTION)
        if shadow_product == 0.0:
            break
        alpha = rho / shadow_product
        advance(system, s, alpha, _DIRECTION, _A_DIRECTION)
        precondition(system, s, _RESIDUAL, _CORRECTION)
        multiply(system, s, _CORRECTION, _A_CORRECTION)
        correction_square = dot(system, s, _A_CORRECTION, _A_CORRECTION)
        if correction_square == 0.0:
            break
        omega = dot(system, s, _A_CORRECTION, _RESIDUAL) / correction_square
        advance(system, s, omega, _CORRECTION, _A_CORRECTION)
        next_rho = dot(system, s, _SHADOW_RESIDUAL, _RESIDUAL)
        residual_norm = ti.sqrt(dot(system, s, _RESIDUAL, _RESIDUAL))
        ends = residual_norm <= goal or iterations >= system.most_iterations
        ends = ends or omega == 0.0 or rho == 0.0
        if not ends:
            update_search_direction(system, s, next_rho / rho * alpha / omega, omega)
            rho = next_rho
    return residual_norm, iterations


@ti.func
@no_type_check
def advance(system: ti.template(), s, step, direction, a_direction):
    """Add ``step`` times ``direction`` to x, and subtract A times this change from r."""
    for c in range(system.diagonal.shape[0]):
        system.work[s, _SOLUTION, c] += step * system.work[s, direction, c]
        system.work[s, _RESIDUAL, c] -= step * system.work[s, a_direction, c]


@ti.func
@no_type_check
def update_search_direction(system: ti.template(), s, beta, omega):
    """Set p to r + beta (p - omega v)."""
    for c in range(system.diagonal.shape[0]):
        system.work[s, _SEARCH_DIRECTION, c] = system.work[s, _RESIDUAL, c] + beta * (
            system.work[s, _SEARCH_DIRECTION, c] - omega * system.work[s, _A_DIRECTION, c]
        )


@ti.func
@no_type_check
def store_results(system: ti.template(), s, rhs):
    """Store rack intakes, returned flow, and the first solution, for right side ``rhs``."""
    for rack in range(system.front_offsets.shape[0] - 1):
        system.intake[rack, rhs] = front_mean(system, s, _SOLUTION, rack)
    total = ti.cast(0.0, ti.f64)
    for i in range(system.return_cell.shape[0]):
        total += system.return_m3s[i] * system.work[s, _SOLUTION, system.return_cell[i]]
    system.returned[rhs] = total
    if rhs == 0:
        for c in range(system.diagonal.shape[0] + 1):
            system.first_solution[c] = system.work[s, _SOLUTION, c]
