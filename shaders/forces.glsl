// What the elements around a pair of sites pull at it with: the stiffness matrix times displacement.
//
// An invocation may do several pairs, one below the other; what the row of elements between two of
// them pulls with is found once for both. The kernel says what displacement is, by `read_row`.
//
// Border rule: elements beyond the border are void (elements.glsl), so that whatever a clamped read
// gives for the sites there counts for nothing.

// Displacement of four sites of a row, the pair being the middle two: the row that is done, and the
// one below it.
vec2 here[4];
vec2 below[4];
// At the two sites of the pair: the force, and what the next row of sites has of its own so far.
vec2 force[2];
vec2 carried[2];

/// Find the displacement of a pair and of the sites before and after it. A kernel defines this.
void read_row(ivec2 pair, out vec2 row[4]);

/// What the elements between two rows of sites pull with; the pair is that of the upper row.
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

/// Get ready for an invocation's first pair. The stage does this, once.
void enter(ivec2 pair)
{
    read_row(pair - VERTICAL, here);
    read_row(pair, below);
    pull(pair - VERTICAL, here, below, force, carried);
}

/// Find the force at a pair: the first, or the one below the last.
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
