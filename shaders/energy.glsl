// Contribution of each pair to U_total (eq. 7): cliques with a site of the pair in the middle, and
// the data terms of both sites.
//
//     share = sum over the four lines of V(s, t, u) + p_row |y_row - d_row| + p_col |y_col - d_col|
//
// summed over both sites of the pair.
//
// Inputs:  displacement  d, pixels; pairs
//          straight, diagonal  stiffness ratios (ratios.glsl)
//          weights       weight of each line, no unit (cliques.glsl)
//          observation   (y in pixels, p = K c in energy per pixel)
// Outputs: share         pixels squared; one value for each pair
// Border rule: cliques that extend beyond the image do not exist, and reads are clamped.

void read_row(ivec2 pair, out vec2 row[4])
{
    read_pairs(displacement, pair, row);
}

/// Return the energy of a site; k is its index in `here`.
float share_of(ivec2 site, int k)
{
    return centred(site, k).energy + observed(here[k], texelFetch(observation, site, 0));
}

void kernel(ivec2 pair)
{
    look_around(pair);
    ivec2 site = first_of(clamped(pair, textureSize(displacement, 0)));
    share = share_of(site, 1) + share_of(site + HORIZONTAL, 2);
}
