// Projection of a field of level 0 to a coarser level, by nearest neighbour (lines 4 to 6).
//
//     values(site) = finest(2^level site + 2^(level - 1))
//
// This is the pixel nearest to the centre of the site. If two pixels are equally near, it is the
// one with the larger index.
//
// Inputs:  finest  any unit: with PAIRS stiffness (m, 1/m), pairs, otherwise observation (y, p)
//          level   scale level n >= 0
//          size    (cols, rows) of the image
// Outputs: values  unit and layout of `finest`
// Border rule: a site with its centre outside the image takes the last row or column. A site that
// is entirely outside, in the additional column of an odd number of columns, is void and gets 0.

uniform int level;
uniform ivec2 size;

/// Return the pixel from which a site takes its value.
ivec2 nearest(ivec2 site)
{
    return clamped((site << level) + ((1 << level) >> 1), size);
}

void kernel(ivec2 texel)
{
#if PAIRS
    ivec2 site = first_of(texel);
    values = vec4(value_at(finest, nearest(site)), value_at(finest, nearest(site + HORIZONTAL)));
    values.zw = in_image((site + HORIZONTAL) << level, size) ? values.zw : vec2(0.0);
#else
    values = texelFetch(finest, nearest(texel), 0);
    values = in_image(texel << level, size) ? values : vec4(0.0);
#endif
}
