// The forces of elastic elements, 2 x 2 blocks of sites (`napari_hmrf.solver.priors.elastic`).
//
// An element has the number of its first site (least row and col). Its displacement is seen as
// three differences per component, D_r along rows, D_c along columns and the twist D_x; from each
// follows what it pulls with at the four corners. Forces are built from these differences and
// never from an assembled stencil, which would lose whole pixels to cancellation in a large image.
//
// Kernels that include this read `lame`: Lame's parameters of the elements, relative to the
// stiffest, 0 where one of the four sites is void; pairs.
//
// Border rule: an element that leaves the image is void. The last row and col of `lame` are so
// already, before the first ones `lame_at` sees to it.

// What the shape of a pixel makes of the differences: `priors.elastic.ElementShape`, in its order:
// rows, cols, mixed, twist_rows, twist_cols, twist_volume.
uniform float shape[6];

/// Lame's parameters of a pair of elements.
vec4 lame_at(ivec2 pair)
{
    vec4 both = texelFetch(lame, clamped(pair, textureSize(lame, 0)), 0);
    return min(pair.x, pair.y) < 0 ? vec4(0.0) : both;
}

/// Add what an element pulls with at its corners, given their displacements; the first digit counts
/// rows, the second columns.
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
