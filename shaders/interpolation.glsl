// Bilinear interpolation of the coarser level's correction. Coarse site i coincides with fine site
// 2 i along each axis.
//
//     fine(2 i) = coarse(i),    fine(2 i + 1) = (coarse(i) + coarse(i + 1)) / 2    along each axis
//
// Inputs:  coarse  correction of the coarser level, pixels; pairs
// Border rule: reads are clamped, which has no effect because all free sites are between coarse
// sites.

// The coarse row at or below the last fine row that was read: two texels with the columns of a pair.
vec4 coarse_texels[2];
bool has_coarse = false;

/// Read a coarse row, at the columns of a pair of fine sites.
void fetch_coarse(ivec2 pair, int coarse_row, out vec4 texels[2])
{
    ivec2 size = textureSize(coarse, 0);
    texels[0] = texelFetch(coarse, clamped(ivec2((pair.x - 1) >> 1, coarse_row), size), 0);
    texels[1] = texelFetch(coarse, clamped(ivec2((pair.x + 1) >> 1, coarse_row), size), 0);
}

/// Read the interpolated correction at the sites of a pair and at their neighbours in the row. After
/// the first call, each call is for the next row.
void read_coarse(ivec2 pair, out vec2 row[4])
{
    if (!has_coarse) {
        fetch_coarse(pair, pair.y >> 1, coarse_texels);
        has_coarse = true;
    }
    vec4 far[2];
    fetch_coarse(pair, (pair.y + 1) >> 1, far);
    vec4 first = coarse_texels[0] + far[0];
    vec4 second = coarse_texels[1] + far[1];
    coarse_texels = far;
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
