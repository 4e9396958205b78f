// Force of the elements around a pair of sites: the stiffness matrix times the displacement.
//
//     force = (A d) at both sites of the pair
//
// An invocation may compute several vertically adjacent pairs. The forces of the elements between
// two pairs are computed once and used for both pairs.
//
// Inputs:  displacement  pixels, read by the kernel's function `read_row`
//          lame, shape   elements (elements.glsl)
// Border rule: elements outside the image are void (elements.glsl), so the values of clamped reads
// do not matter.

// Displacement of four sites of a row, with the pair in the middle: the current row, and the row
// below.
vec2 here[4];
vec2 below[4];
// Force at the two sites of the pair, and the known part of the force at the sites of the next row.
vec2 force[2];
vec2 carried[2];

/// Read the displacement of a pair and its left and right neighbours. The kernel defines this.
void read_row(ivec2 pair, out vec2 row[4]);

/// Compute the forces of the elements between two rows on both rows; `pair` is in the upper row.
void pull(ivec2 pair, vec2 up[4], vec2 down[4], out vec2 upper[2], out vec2 lower[2])
{
    vec2 before = lame_at(pair - HORIZONTAL).zw;
    vec4 both = lame_at(pair);
    vec2 other = vec2(0.0);
    upper[0] = upper[1] = lower[0] = lower[1] = vec2(0.0);
    add_element(before, up[0], up[1], down[0], down[1], other, upper[0], other, lower[0]);
    add_element(both.xy, up[1], up[2], down[1], down[2], upper[0], upper[1], lower[0], lower[1]);
    add_element(both.zw, up[2], up[3], down[2], down[3], upper[1], other, lower[1], other);
}

/// Prepare the first pair of an invocation. The stage calls this function once.
void enter(ivec2 pair)
{
    read_row(pair - VERTICAL, here);
    read_row(pair, below);
    pull(pair - VERTICAL, here, below, force, carried);
}

/// Compute the force at the first pair, or at the pair below the previous pair.
void find_forces(ivec2 pair)
{
    here = below;
    read_row(pair + VERTICAL, below);
    vec2 lower[2];
    pull(pair, here, below, force, lower);
    force[0] += carried[0];
    force[1] += carried[1];
    carried = lower;
}
