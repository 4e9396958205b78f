// Force of the elements around a site: the stiffness matrix times the displacement.
//
//     force = (A d) at the site
//
// Elements are blocks of 2 x 2 x 2 sites (`napari_hmrf.solver.priors.hexahedra`) and have the index
// of their first site. Seven modes per component describe the displacement of an element. The modes
// are sums and differences of the corners: m100 varies along the plane axis, m010 along the row
// axis, m001 along the column axis, and so on. Forces are computed from differences, because in a
// large volume an assembled stencil would lose whole voxels to cancellation. Only modes of the same
// strain are coupled, and lambda contributes only through the mean change in volume.
//
// An invocation computes several sites that are adjacent along the plane axis. The forces of the
// elements between two planes are computed once and used for both sites.
//
// Inputs:  displacement  d, voxels; or the array that DISPLACED defines
//          lame          mu of each element, and lambda if PARAMETERS is 2; 0 if one of the eight
//                        sites is void
//          share         lambda / mu if PARAMETERS is 1, else 1
//          shape         factors of the derivatives along the plane, row and column axes
// Border rule: an element that extends beyond the volume is void, because `lame` is 0 there.

#ifndef DISPLACED
#define DISPLACED(k, number) REAL(displacement[k].at[number])
#endif

// Factors of the derivatives along the plane, row and column axes: `BrickShape`.
uniform REAL shape[3];
uniform REAL share;

// Displacement of 3 x 3 sites of a plane around the invocation's site, component by component: the
// current plane, and the next plane.
REAL here[27];
REAL below[27];
// Force at the site, and the known part of the force at the next site.
REAL force[3];
REAL carried[3];
// Forces of the elements between two planes on the site in the first and in the second plane.
REAL upper[3];
REAL lower[3];

struct Modes { REAL m001, m010, m011, m100, m101, m110, m111; };

/// Read 3 x 3 sites of a plane into `below`.
void read_plane(int at)
{
    int next = pitch();
    for (int k = 0; k < 3; ++k) {
        below[9 * k] = DISPLACED(k, at - next - 1);
        below[9 * k + 1] = DISPLACED(k, at - next);
        below[9 * k + 2] = DISPLACED(k, at - next + 1);
        below[9 * k + 3] = DISPLACED(k, at - 1);
        below[9 * k + 4] = DISPLACED(k, at);
        below[9 * k + 5] = DISPLACED(k, at + 1);
        below[9 * k + 6] = DISPLACED(k, at + next - 1);
        below[9 * k + 7] = DISPLACED(k, at + next);
        below[9 * k + 8] = DISPLACED(k, at + next + 1);
    }
}

/// Return the modes of one component of an element; `first` is the index of its first value.
Modes modes_of(int first)
{
    REAL here00 = here[first], here01 = here[first + 1];
    REAL here10 = here[first + 3], here11 = here[first + 4];
    REAL below00 = below[first], below01 = below[first + 1];
    REAL below10 = below[first + 3], below11 = below[first + 4];
    REAL near = here01 - here00, far = here11 - here10;
    REAL near_below = below01 - below00, far_below = below11 - below10;
    REAL along = (here10 - here00) + (here11 - here01);
    REAL along_below = (below10 - below00) + (below11 - below01);
    REAL across = near + far, across_below = near_below + far_below;
    REAL twist = far - near, twist_below = far_below - near_below;
    Modes m;
    m.m001 = across + across_below;
    m.m101 = across_below - across;
    m.m010 = along + along_below;
    m.m110 = along_below - along;
    m.m011 = twist + twist_below;
    m.m111 = twist_below - twist;
    m.m100 = ((below00 - here00) + (below01 - here01)) + ((below10 - here10) + (below11 - here11));
    return m;
}

/// Add the forces of the modes of component k on the corner with signs `by_row` and `by_col`.
void add_pulls(int k, REAL by_row, REAL by_col, Modes pull)
{
    REAL both = by_row * by_col;
    REAL even = by_col * pull.m001 + by_row * pull.m010 + both * pull.m011;
    REAL odd = pull.m100 + by_col * pull.m101 + by_row * pull.m110 + both * pull.m111;
    upper[k] += even - odd;
    lower[k] += even + odd;
}

/// Return the stiffness factor of modes that vary along two axes, and along three axes.
REAL of_two(REAL own, REAL other) { return (REAL(2) * own * own + other * other) / REAL(3); }
REAL of_three(REAL own, REAL one, REAL other)
{
    return (REAL(2) * own * own + one * one + other * other) / REAL(9);
}

/// Add the forces of an element on the invocation's sites. These sites are in the first row of the
/// element if `behind_row` is 0, otherwise in its last row. `behind_col` selects the column in the
/// same way.
void add_element(int at, int behind_row, int behind_col)
{
    REAL mu = REAL(lame[0].at[at]);
    REAL first = share * REAL(lame[PARAMETERS - 1].at[at]);
    REAL q0 = shape[0], q1 = shape[1], q2 = shape[2];
    REAL third = mu / REAL(3);
    int corner = 3 * (1 - behind_row) + 1 - behind_col;
    Modes u = modes_of(corner);
    Modes v = modes_of(9 + corner);
    Modes w = modes_of(18 + corner);
    REAL e0 = q0 * u.m100, e1 = q1 * v.m010, e2 = q2 * w.m001;
    REAL volume = first * (e0 + e1 + e2);
    REAL s01 = mu * (q1 * u.m010 + q0 * v.m100);
    REAL s02 = mu * (q2 * u.m001 + q0 * w.m100);
    REAL s12 = mu * (q2 * v.m001 + q1 * w.m010);
    REAL t01 = third * (q1 * u.m011 + q0 * v.m101);
    REAL t02 = third * (q2 * u.m011 + q0 * w.m110);
    REAL t12 = third * (q2 * v.m101 + q1 * w.m110);
    REAL two = mu + mu;
    REAL by_row = REAL(2 * behind_row - 1), by_col = REAL(2 * behind_col - 1);
    add_pulls(0, by_row, by_col, Modes(
        q2 * s02, q1 * s01, q1 * t01 + q2 * t02,
        q0 * (volume + two * e0), of_two(q0, q2) * mu * u.m101,
        of_two(q0, q1) * mu * u.m110, of_three(q0, q1, q2) * mu * u.m111));
    add_pulls(1, by_row, by_col, Modes(
        q2 * s12, q1 * (volume + two * e1), of_two(q1, q2) * mu * v.m011,
        q0 * s01, q0 * t01 + q2 * t12,
        of_two(q1, q0) * mu * v.m110, of_three(q1, q0, q2) * mu * v.m111));
    add_pulls(2, by_row, by_col, Modes(
        q2 * (volume + two * e2), q1 * s12, of_two(q2, q1) * mu * w.m011,
        q0 * s02, of_two(q2, q0) * mu * w.m101,
        q0 * t02 + q1 * t12, of_three(q2, q0, q1) * mu * w.m111));
}

/// Compute the forces of the elements between the two planes; `at` is the site in the first plane.
void pull(int at)
{
    for (int k = 0; k < 3; ++k) {
        upper[k] = lower[k] = REAL(0);
    }
    // Not a loop: some compilers would not unroll it, and would store the arrays in memory.
    add_element(at - pitch() - 1, 1, 1);
    add_element(at - pitch(), 1, 0);
    add_element(at - 1, 0, 1);
    add_element(at, 0, 0);
}

/// Prepare the first site of an invocation. The stage calls this function once.
void enter(int at)
{
    read_plane(at - stride());
    here = below;
    read_plane(at);
    pull(at - stride());
    carried = lower;
}

/// Compute the force at the first site, or at the site in the plane after the previous site.
void find_forces(int at)
{
    here = below;
    read_plane(at + stride());
    pull(at);
    for (int k = 0; k < 3; ++k) {
        force[k] = carried[k] + upper[k];
    }
    carried = lower;
}

/// Return component k of the displacement at the site.
REAL displaced(int k) { return here[9 * k + 4]; }
