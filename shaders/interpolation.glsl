// Bilinear interpolation of the coarser level's correction. Coarse site i coincides with fine site
// 2 i along each axis.
//
//     fine(2 i) = coarse(i),    fine(2 i + 1) = (coarse(i) + coarse(i + 1)) / 2    along each axis
//
// Inputs:  coarse  correction of the coarser level, pixels; pairs
// Border rule: reads are clamped, which has no effect because all free sites are between coarse
// sites.

/// Read the interpolated correction at the sites of a pair and at their neighbours in the row.
void read_coarse(ivec2 pair, out vec2 row[4])
{
    ivec2 size = textureSize(coarse, 0);
    ivec2 near = ivec2((pair.x - 1) >> 1, pair.y >> 1);
    ivec2 far = near + ivec2(0, pair.y & 1);
    vec4 first = texelFetch(coarse, clamped(near, size), 0);
    first += texelFetch(coarse, clamped(far, size), 0);
    near.x = far.x = (pair.x + 1) >> 1;
    vec4 second = texelFetch(coarse, clamped(near, size), 0);
    second += texelFetch(coarse, clamped(far, size), 0);
    // Twice the correction at three columns: left of the pair, at its first site, and right of it.
    bool odd = (pair.x & 1) == 1;
    vec2 before = odd ? first.xy : first.zw;
    vec2 on = odd ? first.zw : second.xy;
    vec2 after = odd ? second.xy : second.zw;
    row[0] = 0.25 * (before + on);
    row[1] = 0.5 * on;
    row[2] = 0.25 * (on + after);
    row[3] = 0.5 * after;
}
