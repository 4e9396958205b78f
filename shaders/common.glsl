// Common functions of all kernels for images; this text precedes the text of each kernel.
//
// A site has texture coordinates: site.x is the column, site.y is the row. Values of two components
// are in (row, col) order, like the arrays of the package. All lengths are in pixels of the finest
// level, and all values are float32. A component of the displacement is fixed if it is prescribed
// or has no neighbours, and free otherwise.
//
// Fields with two components (displacement and stiffness) store two sites in each texel, because
// the cost of a read does not depend on the size of the texel. Texel (j, i) is the pair of the
// sites (2j, i) in .xy and (2j + 1, i) in .zw. Other fields have one texel for each site. A level
// with an odd number of columns is padded with one column of void.
//
// Border rule: each kernel has its own rule. A kernel clamps the coordinates of all reads with
// `clamped`, because a read outside a texture is undefined, and uses `in_image` to treat sites
// outside the image as void.

// Lines of cliques, as the step from t to u (figure 2); s is on the opposite side. The order and
// directions are those of `napari_hmrf.solver.priors.cliques.line_steps`.
const ivec2 VERTICAL = ivec2(0, 1);
const ivec2 HORIZONTAL = ivec2(1, 0);
const ivec2 DIAGONAL = ivec2(1, 1);
const ivec2 ANTIDIAGONAL = ivec2(-1, 1);

/// Return the nearest site inside an image of the given size.
ivec2 clamped(ivec2 site, ivec2 size)
{
    return clamp(site, ivec2(0), size - 1);
}

/// Return whether a site is inside an image of the given size.
bool in_image(ivec2 site, ivec2 size)
{
    return all(greaterThanEqual(site, ivec2(0))) && all(lessThan(site, size));
}

/// Return the number of sites, (columns, rows), of a field of pairs.
ivec2 sites_of(sampler2D pairs)
{
    return textureSize(pairs, 0) * ivec2(2, 1);
}

/// Return the value of a field of pairs at a site inside the image.
vec2 value_at(sampler2D pairs, ivec2 site)
{
    vec4 pair = texelFetch(pairs, ivec2(site.x >> 1, site.y), 0);
    return (site.x & 1) == 0 ? pair.xy : pair.zw;
}

/// Return the first site of a pair; the second site is in the next column.
ivec2 first_of(ivec2 pair)
{
    return ivec2(2 * pair.x, pair.y);
}

/// Read the two sites of a pair into row[1] and row[2], and their left and right neighbours into
/// row[0] and row[3].
void read_pairs(sampler2D pairs, ivec2 pair, out vec2 row[4])
{
    ivec2 size = textureSize(pairs, 0);
    vec4 both = texelFetch(pairs, clamped(pair, size), 0);
    row[0] = texelFetch(pairs, clamped(pair - HORIZONTAL, size), 0).zw;
    row[1] = both.xy;
    row[2] = both.zw;
    row[3] = texelFetch(pairs, clamped(pair + HORIZONTAL, size), 0).xy;
}
