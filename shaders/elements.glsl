// Forces of elastic elements, 2 x 2 blocks of sites (`napari_hmrf.solver.priors.elements`).
//
//     f = B^T C B d,    B d = (D_r, D_c, D_x)
//
// An element has the index of its first site (smallest row and column). Three differences per
// component describe its displacement: D_r between the rows, D_c between the columns, and the twist
// D_x. C depends on the Lame parameters and the shape of a pixel. Forces are computed from these
// differences, because in a large image an assembled stencil would lose whole pixels to
// cancellation.
//
// Inputs:  lame   Lame parameters of the elements, relative to the stiffest tissue; 0 if one of the
//                 four sites is void; pairs
//          shape  constants of the shape of a pixel, no unit
// Border rule: an element that extends beyond the image is void. `lame` is 0 in the last row and in
// the last column, and `lame_at` returns 0 before the first row and column.

// Constants of `napari_hmrf.solver.priors.elements.ElementShape`, in this order: rows, cols, mixed,
// twist_rows, twist_cols, twist_volume.
uniform float shape[6];

/// Return the Lame parameters of a pair of elements.
vec4 lame_at(ivec2 pair)
{
    vec4 both = texelFetch(lame, clamped(pair, textureSize(lame, 0)), 0);
    return min(pair.x, pair.y) < 0 ? vec4(0.0) : both;
}

/// Add the forces of an element at its corners, given the displacements of the corners. The first
/// digit of a name is the row of the corner, and the second digit is the column.
void add_element(
    vec2 lame, vec2 d00, vec2 d01, vec2 d10, vec2 d11,
    inout vec2 f00, inout vec2 f01, inout vec2 f10, inout vec2 f11)
{
    vec2 left = d10 - d00;
    vec2 right = d11 - d01;
    vec2 rows = left + right;
    vec2 twist = right - left;
    vec2 cols = (d01 - d00) + (d11 - d10);
    float both = lame.x + 2.0 * lame.y;
    float own = shape[5] * lame.x + 2.0 * lame.y;
    rows = vec2(
        shape[0] * both * rows.x + shape[2] * lame.x * cols.y,
        lame.y * (shape[0] * rows.y + shape[2] * cols.x));
    cols = vec2(
        lame.y * (shape[1] * cols.x + shape[2] * (left.y + right.y)),
        shape[1] * both * cols.y + shape[2] * lame.x * (left.x + right.x));
    twist *= own * vec2(shape[3], shape[4]) + lame.y * vec2(shape[4], shape[3]);
    f00 += twist - rows - cols;
    f01 += cols - rows - twist;
    f10 += rows - cols - twist;
    f11 += rows + cols + twist;
}
