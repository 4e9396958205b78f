// What every kernel shares; put before the kernel's own text.
//
// A site is addressed the way textures are: site.x counts columns, site.y counts rows. Values of
// two components are in (row, col) order, as the arrays of the package are. All lengths are in
// pixels of the finest level, all values float32.
//
// Fields of two components, displacement and stiffness, keep two sites in a texel, because reading
// a texel costs the same however much is in it: texel (j, i) is the pair of the sites (2j, i) in
// .xy and (2j + 1, i) in .zw. Everything else has a texel for each site. A level with an odd number
// of columns gets one more, of void.
//
// Border rule: none of its own. A kernel clamps every coordinate it reads with `clamped`, since a
// read outside of a texture is undefined, and asks `in_image` where outside must count as void.

// The lines, from t to u (figure 2); s lies on the other side. Order and direction as in
// `napari_hmrf.solver.priors.LINES`.
const ivec2 VERTICAL = ivec2(0, 1);
const ivec2 HORIZONTAL = ivec2(1, 0);
const ivec2 DIAGONAL = ivec2(1, 1);
const ivec2 ANTIDIAGONAL = ivec2(-1, 1);

/// The nearest site that lies in an image of this size.
ivec2 clamped(ivec2 site, ivec2 size)
{
    return clamp(site, ivec2(0), size - 1);
}

/// Whether a site lies in an image of this size.
bool in_image(ivec2 site, ivec2 size)
{
    return all(greaterThanEqual(site, ivec2(0))) && all(lessThan(site, size));
}

/// How many sites a field of pairs has.
ivec2 sites_of(sampler2D pairs)
{
    return textureSize(pairs, 0) * ivec2(2, 1);
}

/// The value of a field of pairs at a site that lies in it.
vec2 value_at(sampler2D pairs, ivec2 site)
{
    vec4 pair = texelFetch(pairs, ivec2(site.x >> 1, site.y), 0);
    return (site.x & 1) == 0 ? pair.xy : pair.zw;
}

/// The first site of a pair; the second is `HORIZONTAL` away.
ivec2 first_of(ivec2 pair)
{
    return ivec2(2 * pair.x, pair.y);
}

/// Read a pair of a field, and the sites before and after it.
void read_pairs(sampler2D pairs, ivec2 pair, out vec2 row[4])
{
    ivec2 size = textureSize(pairs, 0);
    vec4 both = texelFetch(pairs, clamped(pair, size), 0);
    row[0] = texelFetch(pairs, clamped(pair - HORIZONTAL, size), 0).zw;
    row[1] = both.xy;
    row[2] = both.zw;
    row[3] = texelFetch(pairs, clamped(pair + HORIZONTAL, size), 0).xy;
}
