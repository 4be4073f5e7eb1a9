"""Air in a hall on a grid of cells: sparse systems of seven points per cell, solved per tag.

Cells that hold air are numbered 0..N-1; index N stands for no cell: its unknown stays zero. Faces
of a cell are numbered -x, -y, -z, +x, +y, +z, and lower faces lead to lower numbers. A system is
``diagonal * x - sum over faces of off * x of the cell beyond = rhs`` with off >= 0.
"""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import SLICE, part_of

VECTORS = 9
"""Work vectors of one thread: solution, residual, shadow residual, direction, and products."""

_X, _R, _SHADOW, _P, _V, _T, _Y, _Z, _PIVOT = range(VECTORS)


@cache
def transport_kernel() -> Any:
    """Kernel that turns a potential into face flows and the coefficients of the tag transport.

    Flow through a face is conductance times the drop in potential. A tag c crosses it as
    q*(c_P + c_N)/2 + G*(c_P - c_N) with G = max(mixing*speed*conductance, |q|/2): central
    differences where the mixing keeps them bounded, upwind elsewhere (hybrid scheme of Spalding
    1972, International Journal for Numerical Methods in Engineering 4(4)). ``speed`` is the mean
    of both cells. ``boundary`` is the flow that leaves the hall through a face, (N, 6).
    """
    reals_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)
    reals_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)

    @ti.kernel
    @no_type_check
    def transport(
        beyond: ints_2d,
        conductance: reals_2d,
        boundary: reals_2d,
        area: reals_2d,
        mixing: ti.f64,
        potential: reals_1d,
        speed: reals_1d,
        imbalance: reals_1d,
        off: reals_2d,
        diagonal: reals_1d,
    ):
        for c in range(diagonal.shape[0]):
            net = ti.cast(0.0, ti.f64)
            square = ti.cast(0.0, ti.f64)
            for axis in range(3):
                low = boundary[c, axis] + conductance[c, axis] * (
                    potential[c] - potential[beyond[c, axis]]
                )
                high = boundary[c, axis + 3] + conductance[c, axis + 3] * (
                    potential[c] - potential[beyond[c, axis + 3]]
                )
                net += low + high
                u = (high - low) / (2.0 * area[c, axis])
                square += u * u
            imbalance[c] = net
            speed[c] = ti.sqrt(square)
        for c in range(diagonal.shape[0]):
            total = ti.cast(0.0, ti.f64)
            for f in range(6):
                n = beyond[c, f]
                q = conductance[c, f] * (potential[c] - potential[n])
                g = ti.max(
                    0.5 * mixing * (speed[c] + speed[n]) * conductance[c, f], 0.5 * ti.abs(q)
                )
                off[c, f] = g - 0.5 * q
                total += g + 0.5 * q + ti.max(boundary[c, f], 0.0)
            diagonal[c] = total

    return transport


@cache
def solve_kernel() -> Any:
    """Kernel that solves one system per tag, each on one thread, so that threads change no bit.

    Stabilised bi-conjugate gradients (van der Vorst 1992, SIAM J. Sci. Stat. Comput. 13(2)) with a
    diagonal incomplete LU as preconditioner (Pommerell 1992, dissertation, ETH Zurich). The
    residual is computed afresh at every start, and a system that is not at the tolerance is
    started again from where it is.

    ``source`` pairs cells with amounts, in runs per tag. With ``coupled`` air passes the racks: the
    mean over the front faces of a rack enters the cells at its back.
    Out: solution (tags, N + 1) where ``keep``, else (1, N + 1) untouched; means over the fronts of
    each rack (racks, tags); sum over the returns (tags,); residual over right-hand side, and
    iterations, (tags,).
    """
    reals_3d = ti.types.ndarray(dtype=ti.f64, ndim=3)
    reals_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)
    reals_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.func
    @no_type_check
    def dot(work: reals_3d, s, a, b, n):
        total = ti.cast(0.0, ti.f64)
        for c in range(n):
            total += work[s, a, c] * work[s, b, c]
        return total

    @ti.func
    @no_type_check
    def multiply(
        coupled: ti.template(),
        beyond: ints_2d,
        off: reals_2d,
        diagonal: reals_1d,
        front_start: ints_1d,
        front_cell: ints_1d,
        front_share: reals_1d,
        back_start: ints_1d,
        back_cell: ints_1d,
        back_m3s: reals_1d,
        work: reals_3d,
        s,
        a,
        out,
    ):
        for c in range(diagonal.shape[0]):
            total = diagonal[c] * work[s, a, c]
            for f in ti.static(range(6)):
                total -= off[c, f] * work[s, a, beyond[c, f]]
            work[s, out, c] = total
        if ti.static(coupled):
            for j in range(front_start.shape[0] - 1):
                mean = ti.cast(0.0, ti.f64)
                for i in range(front_start[j], front_start[j + 1]):
                    mean += front_share[i] * work[s, a, front_cell[i]]
                for i in range(back_start[j], back_start[j + 1]):
                    work[s, out, back_cell[i]] -= back_m3s[i] * mean

    @ti.func
    @no_type_check
    def precondition(beyond: ints_2d, off: reals_2d, diagonal: reals_1d, work: reals_3d, s, a, out):
        cells = diagonal.shape[0]
        for c in range(cells):
            total = work[s, a, c]
            for f in ti.static(range(3)):
                total += off[c, f] * work[s, out, beyond[c, f]]
            work[s, out, c] = total * work[s, _PIVOT, c]
        for i in range(cells):
            c = cells - 1 - i
            total = ti.cast(0.0, ti.f64)
            for f in ti.static(range(3, 6)):
                total += off[c, f] * work[s, out, beyond[c, f]]
            work[s, out, c] += total * work[s, _PIVOT, c]

    @ti.kernel
    @no_type_check
    def solve(
        coupled: ti.template(),
        keep: ti.template(),
        slices: ti.i32,
        most_iterations: ti.i32,
        tolerance: ti.f64,
        beyond: ints_2d,
        off: reals_2d,
        diagonal: reals_1d,
        source_start: ints_1d,
        source_cell: ints_1d,
        source: reals_1d,
        front_start: ints_1d,
        front_cell: ints_1d,
        front_share: reals_1d,
        back_start: ints_1d,
        back_cell: ints_1d,
        back_m3s: reals_1d,
        return_cell: ints_1d,
        return_m3s: reals_1d,
        work: reals_3d,
        solution: reals_2d,
        intake: reals_2d,
        returned: reals_1d,
        residual: reals_1d,
        iterations: ints_1d,
    ):
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                s = k // SLICE
                n = diagonal.shape[0]
                for v in range(work.shape[1]):
                    work[s, v, n] = 0.0
                for c in range(n):
                    pivot = diagonal[c]
                    for f in range(3):
                        b = beyond[c, f]
                        if b < n:
                            pivot -= off[c, f] * off[b, f + 3] * work[s, _PIVOT, b]
                    work[s, _PIVOT, c] = 1.0 / pivot
                first, end = part_of(s, slices, residual.shape[0])
                for tag in range(first, end):
                    for c in range(n):
                        work[s, _X, c] = 0.0
                        work[s, _Z, c] = 0.0
                    for i in range(source_start[tag], source_start[tag + 1]):
                        work[s, _Z, source_cell[i]] += source[i]
                    goal = tolerance * ti.sqrt(dot(work, s, _Z, _Z, n))
                    done = 0
                    rounds = 0
                    size = ti.cast(0.0, ti.f64)
                    while rounds < 20:
                        rounds += 1
                        for c in range(n):
                            work[s, _Z, c] = 0.0
                        for i in range(source_start[tag], source_start[tag + 1]):
                            work[s, _Z, source_cell[i]] += source[i]
                        multiply(
                            coupled, beyond, off, diagonal, front_start, front_cell, front_share,
                            back_start, back_cell, back_m3s, work, s, _X, _R,
                        )  # fmt: skip
                        for c in range(n):
                            work[s, _R, c] = work[s, _Z, c] - work[s, _R, c]
                            work[s, _SHADOW, c] = work[s, _R, c]
                            work[s, _P, c] = work[s, _R, c]
                        rho = dot(work, s, _R, _R, n)
                        size = ti.sqrt(rho)
                        if size <= goal or done >= most_iterations:
                            break
                        going = 1
                        while going == 1:
                            done += 1
                            precondition(beyond, off, diagonal, work, s, _P, _Y)
                            multiply(
                                coupled, beyond, off, diagonal, front_start, front_cell,
                                front_share, back_start, back_cell, back_m3s, work, s, _Y, _V,
                            )  # fmt: skip
                            against = dot(work, s, _SHADOW, _V, n)
                            if against == 0.0:
                                break
                            alpha = rho / against
                            for c in range(n):
                                work[s, _X, c] += alpha * work[s, _Y, c]
                                work[s, _R, c] -= alpha * work[s, _V, c]
                            precondition(beyond, off, diagonal, work, s, _R, _Z)
                            multiply(
                                coupled, beyond, off, diagonal, front_start, front_cell,
                                front_share, back_start, back_cell, back_m3s, work, s, _Z, _T,
                            )  # fmt: skip
                            square = dot(work, s, _T, _T, n)
                            if square == 0.0:
                                break
                            omega = dot(work, s, _T, _R, n) / square
                            for c in range(n):
                                work[s, _X, c] += omega * work[s, _Z, c]
                                work[s, _R, c] -= omega * work[s, _T, c]
                            following = dot(work, s, _SHADOW, _R, n)
                            size = ti.sqrt(dot(work, s, _R, _R, n))
                            if size <= goal or done >= most_iterations:
                                going = 0
                            elif omega == 0.0 or rho == 0.0:
                                going = 0
                            else:
                                beta = following / rho * alpha / omega
                                rho = following
                                for c in range(n):
                                    work[s, _P, c] = work[s, _R, c] + beta * (
                                        work[s, _P, c] - omega * work[s, _V, c]
                                    )
                    residual[tag] = 0.0
                    if goal > 0.0:
                        residual[tag] = tolerance * size / goal
                    iterations[tag] = done
                    for j in range(front_start.shape[0] - 1):
                        mean = ti.cast(0.0, ti.f64)
                        for i in range(front_start[j], front_start[j + 1]):
                            mean += front_share[i] * work[s, _X, front_cell[i]]
                        intake[j, tag] = mean
                    total = ti.cast(0.0, ti.f64)
                    for i in range(return_cell.shape[0]):
                        total += return_m3s[i] * work[s, _X, return_cell[i]]
                    returned[tag] = total
                    if ti.static(keep):
                        for c in range(n + 1):
                            solution[tag, c] = work[s, _X, c]

    return solve
