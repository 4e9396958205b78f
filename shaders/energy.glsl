// Each pair's share of U_total (eq. 7): the cliques its sites are the middle of, and their data
// terms.
//
//     share = sum over the four lines of V(s, t, u) + p_row |y_row - d_row| + p_col |y_col - d_col|,
//             of both sites
//
// Inputs:  displacement  d, pixels; pairs
//          straight, diagonal  stiffness ratios (ratios.glsl); the lines' weights: cliques.glsl
//          observation   (y in pixels, p = K c in energy per pixel)
// Outputs: share         pixels squared; one value for a pair
// Border rule: cliques that leave the image do not exist; reads are clamped to the image.

void kernel(ivec2 pair)
{
    Around first, second;
    look_around(pair, first, second);
    ivec2 site = first_of(pair);
    share = centred(site, first).energy + observed(first.here[1], texelFetch(observation, site, 0));
    site += HORIZONTAL;
    share += centred(site, second).energy + observed(second.here[1], texelFetch(observation, site, 0));
}
