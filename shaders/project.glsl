// A field of level 0 on the sites of a coarser level, by nearest neighbour (lines 4 to 6).
//
//     values(site) = finest(2^level site + 2^(level - 1)), the pixel nearest to the site's centre;
//                    half-way between two, the later one
//
// Inputs:  finest  any unit: stiffness (m, 1/m) or observation (y, p)
//          level   the scale level n >= 0
// Outputs: values  the same unit
// Border rule: a site whose centre lies beyond the image takes the last row or column.

uniform int level;

void kernel(ivec2 site)
{
    ivec2 pixel = (site << level) + ((1 << level) >> 1);
    values = texelFetch(finest, clamped(pixel, textureSize(finest, 0)), 0);
}
