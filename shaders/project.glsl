// Projection of a field of level 0 to a coarser level, by nearest neighbour (lines 4 to 6).
//
//     values(site) = finest(2^level site + 2^(level - 1))
//
// The pixel on the right-hand side is the nearest pixel to the centre of the site. If two pixels
// are equally near, it is the pixel with the larger index.
//
// Inputs:  finest  any unit; stiffness (m, 1/m) in pairs with PAIRS, otherwise observation (y, p)
//          level   scale level n >= 0
//          size    (cols, rows) of the image
// Outputs: values  unit and layout of `finest`
// Border rule: a site with its centre outside the image uses the last row or column. A site in the
// padding column of an odd number of columns is entirely outside the image, and its values are 0.

uniform int level;
uniform ivec2 size;

/// Return the pixel that provides the value of a site.
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
