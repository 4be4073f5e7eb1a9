"""Airflow in a hall on a grid of cells: transport coefficients, and BiCGSTAB for linear systems.

Cells that hold air have the numbers 0..N-1. Index N stands for "no cell"; its unknown stays zero.
The faces of a cell are numbered -x, -y, -z, +x, +y, +z; the neighbours beyond the first three
have lower numbers than the cell. The matrix A of a system has ``diagonal`` on its diagonal. In the
column of the cell beyond each face it has -``off_diagonal``, which is at most 0. With
``through_racks``, air also passes through the racks: the air that leaves a back face carries the
mean of the unknown over the front of its rack, times the airflow of the face.

The solver is the stabilised biconjugate gradient method (van der Vorst 1992, SIAM J. Sci. Stat.
Comput. 13(2)). It is preconditioned by K = (D + L) D^-1 (D + U), a diagonal incomplete LU
factorisation (Pommerell 1992, dissertation, ETH Zurich) that adds most of its fill-in to the
diagonal (Axelsson and Lindskog 1986, Numer. Math. 48(5)), which saves a third of the iterations. L
and U are the parts of A below and above its diagonal, without the terms of racks. The iterations
solve B y = (D + L)^-1 b, where
B = (D + L)^-1 A (I + D^-1 U)^-1 and y = (I + D^-1 U) x. The product of B and a vector takes one
solution with I + D^-1 U and one with D + L, and no product with A (Eisenstat 1981, SIAM J. Sci.
Stat. Comput. 2(1)). Each line names its function on the right:

    y <- 0                                                          solve_right_sides
    repeat, at most MOST_STARTS times:
        r <- (D + L)^-1 (b - A x);  r^ <- r;  rho <- (r^, r)        start_iterations
        if |b - A x| <= tolerance |b|: done
        repeat until r has fallen as far as b - A x has to:         iterate
            p <- r + beta (p - omega v);  z <- (I + D^-1 U)^-1 p
            v <- B p = z + (D + L)^-1 (A z - (D + L) z);  alpha <- rho / (r^, v)
            r <- r - alpha v;  z <- (I + D^-1 U)^-1 r
            t <- B r;  omega <- (t, r) / (t, t)
            y <- y + alpha p + omega r;  r <- r - omega t
            beta <- (r^, r) / rho * alpha / omega;  rho <- (r^, r)

Iterations update r instead of computing it anew, so r drifts from (D + L)^-1 (b - A x). The solver
therefore restarts several times, each time from the y found so far. All starts together do at most
``most_iterations`` iterations.

Each sweep over the cells must wait for the values of the cells before. Right sides are therefore
solved side by side, one in each lane of a vector. The lanes do not affect each other, and one
thread solves each vector, so neither lanes nor threads change any bit of the result.
"""

from dataclasses import replace
from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .arguments import Argument
from .compiler.functions import part_of
from .compiler.named_kernel import define_kernel

LANES, FEW_LANES = 8, 2
"""Number of right sides that are solved side by side, and number for one or two right sides."""
WORK_VECTORS = 7
"""Work vectors of N + 1 entries per thread; with ``through_racks`` there is one more."""

(
    _SOLUTION,  # y
    _RESIDUAL,  # r
    _SHADOW_RESIDUAL,  # r^
    _SEARCH_DIRECTION,  # p
    _B_DIRECTION,  # v = B p
    _B_RESIDUAL,  # t = B r
    _UNSCALED,  # z, and x where it is needed
) = range(WORK_VECTORS)
_CARRIED = WORK_VECTORS  # what air carries from the fronts of racks to their backs

MOST_STARTS = 20
"""Maximum number of starts for a right side, including the first."""
_FILL = 0.95
"""Share of the fill-in outside of the pattern of A that the factorisation adds to its diagonal."""
_FALL = 0.5
"""Fall of the residual that iterations aim at, divided by the fall that is needed."""

SYSTEM_ARGUMENTS = {
    "serial": Argument("template"),  # True: run on the calling thread alone
    "through_racks": Argument("i32"),  # 1 if air passes through the racks, otherwise 0
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
    "work": Argument("f64", 3),  # vectors of lanes, (slices, WORK_VECTORS, N + 1)
    "inverse_pivot": Argument("f64", 2),  # 1 / D, (slices, N + 1)
    # Results, and the return openings at which the solutions are evaluated.
    "return_cell": Argument("i32", 1),  # cell before each return face
    "return_m3s": Argument("f64", 1),  # flow out of each return face, m3/s
    "first_solution": Argument("f64", 1),  # solution of the first right side, (N + 1,)
    # Vectors of lanes, for each of G groups of right sides.
    "intake": Argument("f64", 2),  # mean solution over the front of each rack, (R, G)
    "returned": Argument("f64", 1),  # flow times solution, summed over the returns, (G,)
    "relative_residual": Argument("f64", 1),  # |r| / |b|, 0 where b is 0, (G,)
    "iterations": Argument("f64", 1),  # number of iterations, (G,)
}
"""Arguments of the kernels of ``bicgstab_kernel`` by name, template arguments first."""
_OF_LANES = {"work", "intake", "returned", "relative_residual", "iterations"}


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
def bicgstab_kernel(lanes: int) -> Any:
    """Return the kernel that solves the linear system for every right side by BiCGSTAB.

    The module docstring gives the algorithm. SYSTEM_ARGUMENTS lists the arguments of the kernel.

    Args:
        lanes: number of right sides that are solved side by side, at least 2.
    """
    arguments = {
        name: replace(argument, lanes=lanes) if name in _OF_LANES else argument
        for name, argument in SYSTEM_ARGUMENTS.items()
    }
    name, constants = f"solve_{lanes}_systems", {"lanes": lanes}
    return define_kernel(
        name, arguments, run_slice, precision="f64", lanes=lanes, constants=constants
    )


@ti.func
@no_type_check
def run_slice(system: ti.template(), s):
    """Solve the right sides of slice ``s``, with ``work[s]`` as work space."""
    no_cell = system.diagonal.shape[0]
    for vector in range(WORK_VECTORS):
        system.work[s, vector, no_cell] = system.zeros
    if system.through_racks == 1:
        for c in range(no_cell):
            system.work[s, _CARRIED, c] = system.zeros
    factorise(system, s)
    first, end = part_of(s, system.slices, system.relative_residual.shape[0])
    for group in range(first, end):
        solve_right_sides(system, s, group)
        store_results(system, s, group)


@ti.func
@no_type_check
def factorise(system: ti.template(), s):
    """Compute 1 / D.

    D_c = A_cc - sum of A_cb (A_bc + _FILL * sum of A_bk) / D_b over the lower neighbours b of cell
    c, and over the other higher neighbours k of each b.
    """
    cells = system.diagonal.shape[0]
    for c in range(cells):
        pivot = system.diagonal[c]
        for face in range(3):
            b = system.beyond[c, face]
            if b < cells:
                carried = (1.0 - _FILL) * system.off_diagonal[b, face + 3]
                for upper in ti.static(range(3, 6)):
                    carried += _FILL * system.off_diagonal[b, upper]
                pivot -= system.off_diagonal[c, face] * carried * system.inverse_pivot[s, b]
        system.inverse_pivot[s, c] = 1.0 / pivot


@ti.func
@no_type_check
def above(system: ti.template(), s, vector, c):
    """Return the sum of -U_cb times a work vector over the higher neighbours b of cell c."""
    total = system.zeros
    for face in ti.static(range(3, 6)):
        total = (
            total + system.off_diagonal[c, face] * (system.work[s, vector, system.beyond[c, face]])
        )
    return total


@ti.func
@no_type_check
def unscale(system: ti.template(), s, vector):
    """Set z to (I + D^-1 U)^-1 times a work vector."""
    cells = system.diagonal.shape[0]
    for i in range(cells):
        c = cells - 1 - i
        system.work[s, _UNSCALED, c] = system.work[s, vector, c] + system.inverse_pivot[
            s, c
        ] * above(system, s, _UNSCALED, c)


@ti.func
@no_type_check
def multiplied(system: ti.template(), s, vector, out, c):
    """Return entry c of B times a work vector, and store it in ``out``; z belongs to the vector.

    All lower entries of ``out`` must have been computed. With w = (D + L)^-1 (A z - (D + L) z),
    B p = z + w, and (D + L) w = D p + (diagonal - 2 D) z.
    """
    inverse_pivot = system.inverse_pivot[s, c]
    z = system.work[s, _UNSCALED, c]
    total = (system.diagonal[c] - 2.0 / inverse_pivot) * z
    for face in ti.static(range(3)):
        b = system.beyond[c, face]
        total = total + system.off_diagonal[c, face] * (
            system.work[s, out, b] - system.work[s, _UNSCALED, b]
        )
    if system.through_racks == 1:
        total = total - system.work[s, _CARRIED, c]
    product = z + system.work[s, vector, c] + inverse_pivot * total
    system.work[s, out, c] = product
    return product


@ti.func
@no_type_check
def front_mean(system: ti.template(), s, vector, rack):
    """Return the mean of a work vector over the front of a rack, weighted by airflow."""
    mean = system.zeros
    for i in range(system.front_offsets[rack], system.front_offsets[rack + 1]):
        mean = mean + system.front_share[i] * system.work[s, vector, system.front_cell[i]]
    return mean


@ti.func
@no_type_check
def carry_through_racks(system: ti.template(), s):
    """Set the last work vector to what air carries from the fronts of racks to their backs."""
    if system.through_racks == 1:
        for i in range(system.back_cell.shape[0]):
            system.work[s, _CARRIED, system.back_cell[i]] = system.zeros
        for rack in range(system.front_offsets.shape[0] - 1):
            mean = front_mean(system, s, _UNSCALED, rack)
            for i in range(system.back_offsets[rack], system.back_offsets[rack + 1]):
                c = system.back_cell[i]
                carried = system.work[s, _CARRIED, c] + system.back_m3s[i] * mean
                system.work[s, _CARRIED, c] = carried


@ti.func
@no_type_check
def load_right_sides(system: ti.template(), s, group, out):
    """Set the lanes of ``out`` to the right sides of a group, and lanes beyond the last to 0."""
    for c in range(system.diagonal.shape[0]):
        system.work[s, out, c] = system.zeros
    for lane in range(system.lanes):
        rhs = group * system.lanes + lane
        if rhs < system.source_offsets.shape[0] - 1:
            unit = ti.Vector([ti.cast(k == lane, ti.f64) for k in ti.static(range(system.lanes))])
            for i in range(system.source_offsets[rhs], system.source_offsets[rhs + 1]):
                c = system.source_cell[i]
                system.work[s, out, c] = system.work[s, out, c] + system.source[i] * unit


@ti.func
@no_type_check
def solve_right_sides(system: ti.template(), s, group):
    """Solve for the right sides of a group; store iterations and relative residuals."""
    cells = system.diagonal.shape[0]
    load_right_sides(system, s, group, _RESIDUAL)
    square = system.zeros
    for c in range(cells):
        square = square + system.work[s, _RESIDUAL, c] * system.work[s, _RESIDUAL, c]
        system.work[s, _SOLUTION, c] = system.zeros
    goal = system.tolerance * ti.sqrt(square)
    most_iterations = system.zeros + ti.cast(system.most_iterations, ti.f64)
    iterations = system.zeros
    residual_norm = system.zeros
    starts, ends = 0, False
    while starts < MOST_STARTS and not ends:
        starts += 1
        rho, residual_norm = start_iterations(system, s, group)
        zeros, ones = system.zeros, system.zeros + 1.0
        unsolved = ti.select(residual_norm > goal, ones, zeros)
        unsolved = ti.select(iterations < most_iterations, unsolved, zeros)
        ends = unsolved.sum() == 0.0
        if not ends:
            fall = _FALL * quotient(goal, residual_norm)
            iterations = iterate(system, s, rho, fall * ti.sqrt(rho), unsolved, iterations)
    system.relative_residual[group] = system.tolerance * quotient(residual_norm, goal)
    system.iterations[group] = iterations


@ti.func
@no_type_check
def start_iterations(system: ti.template(), s, group):
    """Set r and r^ to (D + L)^-1 (b - A x), and p and v to 0; return rho and |b - A x|."""
    load_right_sides(system, s, group, _RESIDUAL)
    unscale(system, s, _SOLUTION)
    carry_through_racks(system, s)
    square, rho = system.zeros, system.zeros
    for c in range(system.diagonal.shape[0]):
        residual = (
            system.work[s, _RESIDUAL, c]
            - system.diagonal[c] * system.work[s, _UNSCALED, c]
            + above(system, s, _UNSCALED, c)
        )
        if system.through_racks == 1:
            residual = residual + system.work[s, _CARRIED, c]
        for face in ti.static(range(3)):
            residual = (
                residual
                + system.off_diagonal[c, face] * (system.work[s, _UNSCALED, system.beyond[c, face]])
            )
        square = square + residual * residual
        for face in ti.static(range(3)):
            residual = (
                residual
                + system.off_diagonal[c, face] * (system.work[s, _RESIDUAL, system.beyond[c, face]])
            )
        residual = residual * system.inverse_pivot[s, c]
        rho = rho + residual * residual
        system.work[s, _RESIDUAL, c] = residual
        system.work[s, _SHADOW_RESIDUAL, c] = residual
        system.work[s, _SEARCH_DIRECTION, c] = system.zeros
        system.work[s, _B_DIRECTION, c] = system.zeros
    return rho, ti.sqrt(square)


@ti.func
@no_type_check
def quotient(a, b):
    """Return a / b, and 0 where b is 0."""
    zeros = b * 0.0
    return ti.select(b == zeros, zeros, a / ti.select(b == zeros, zeros + 1.0, b))


@ti.func
@no_type_check
def iterate(system: ti.template(), s, rho_at_start, goal, unsolved, iterations_before):
    """Iterate until |r| of each unsolved lane reaches its goal, or a divisor is 0.

    Lanes that have ended do not change any more.

    Returns:
        The number of iterations of each lane since the first start.
    """
    cells = system.diagonal.shape[0]
    most_iterations = system.zeros + ti.cast(system.most_iterations, ti.f64)
    rho, iterations, runs = rho_at_start, iterations_before, unsolved
    beta, omega = system.zeros, system.zeros
    running = runs.sum()
    while running > 0.0:
        iterations = iterations + runs
        for i in range(cells):
            c = cells - 1 - i
            direction = system.work[s, _RESIDUAL, c] + beta * (
                system.work[s, _SEARCH_DIRECTION, c] - omega * system.work[s, _B_DIRECTION, c]
            )
            system.work[s, _SEARCH_DIRECTION, c] = direction
            system.work[s, _UNSCALED, c] = direction + system.inverse_pivot[s, c] * above(
                system, s, _UNSCALED, c
            )
        carry_through_racks(system, s)
        shadow_product = system.zeros
        for c in range(cells):
            v = multiplied(system, s, _SEARCH_DIRECTION, _B_DIRECTION, c)
            shadow_product = shadow_product + system.work[s, _SHADOW_RESIDUAL, c] * v
        alpha = runs * quotient(rho, shadow_product)
        for i in range(cells):
            c = cells - 1 - i
            residual = system.work[s, _RESIDUAL, c] - alpha * system.work[s, _B_DIRECTION, c]
            system.work[s, _RESIDUAL, c] = residual
            system.work[s, _UNSCALED, c] = residual + system.inverse_pivot[s, c] * above(
                system, s, _UNSCALED, c
            )
        carry_through_racks(system, s)
        square, product = system.zeros, system.zeros
        for c in range(cells):
            t = multiplied(system, s, _RESIDUAL, _B_RESIDUAL, c)
            square = square + t * t
            product = product + t * system.work[s, _RESIDUAL, c]
        omega = runs * quotient(product, square)
        next_rho, residual_square = system.zeros, system.zeros
        for c in range(cells):
            residual = system.work[s, _RESIDUAL, c]
            system.work[s, _SOLUTION, c] = (
                system.work[s, _SOLUTION, c]
                + alpha * system.work[s, _SEARCH_DIRECTION, c]
                + omega * residual
            )
            residual = residual - omega * system.work[s, _B_RESIDUAL, c]
            system.work[s, _RESIDUAL, c] = residual
            next_rho = next_rho + system.work[s, _SHADOW_RESIDUAL, c] * residual
            residual_square = residual_square + residual * residual
        runs = ti.select(ti.sqrt(residual_square) > goal, runs, system.zeros)
        runs = ti.select(iterations < most_iterations, runs, system.zeros)
        runs = ti.select(omega * next_rho == system.zeros, system.zeros, runs)
        beta = runs * quotient(next_rho, rho) * quotient(alpha, omega)
        rho = next_rho
        running = runs.sum()
    return iterations


@ti.func
@no_type_check
def store_results(system: ti.template(), s, group):
    """Store rack intakes, returned flow, and the first solution, for the right sides of a group."""
    unscale(system, s, _SOLUTION)
    for rack in range(system.front_offsets.shape[0] - 1):
        system.intake[rack, group] = front_mean(system, s, _UNSCALED, rack)
    total = system.zeros
    for i in range(system.return_cell.shape[0]):
        total = total + system.return_m3s[i] * system.work[s, _UNSCALED, system.return_cell[i]]
    system.returned[group] = total
    if group == 0:
        for c in range(system.diagonal.shape[0] + 1):
            system.first_solution[c] = system.work[s, _UNSCALED, c][0]
