// Force of the elements around a pair of sites: the stiffness matrix times displacement.
//
//     force = (A d) at both sites of the pair
//
// An invocation may compute several pairs, one below the other; the forces of the row of elements
// between two pairs are computed once for both.
//
// Inputs:  displacement  pixels, by the function `read_row` of the kernel
//          lame, shape   elements (elements.glsl)
// Border rule: elements outside the image are void (elements.glsl), so the values of clamped reads
// do not matter.

// Displacement of four sites of a row, with the pair as the middle two: the present row, and the
// row below it.
vec2 here[4];
vec2 below[4];
// At the two sites of the pair: the force, and the part of the next row's force that is known.
vec2 force[2];
vec2 carried[2];

/// Read the displacement of a pair and of the sites before and after it. A kernel defines this.
void read_row(ivec2 pair, out vec2 row[4]);

/// Compute the forces of the elements between two rows of sites on both; `pair` is the upper one.
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

/// Prepare the first pair of an invocation. The stage calls this once.
void enter(ivec2 pair)
{
    read_row(pair - VERTICAL, here);
    read_row(pair, below);
    pull(pair - VERTICAL, here, below, force, carried);
}

/// Compute the force at a pair: the first one, or the one below the previous pair.
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
