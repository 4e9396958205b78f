// Each site's share of U_total (eq. 7): the cliques it is the middle of, and its data term.
//
//     share = sum over the four lines of V(s, t, u) + p_row |y_row - d_row| + p_col |y_col - d_col|
//
// Inputs:  displacement  d, pixels
//          straight, diagonal  stiffness ratios (ratios.glsl); the lines' weights: cliques.glsl
//          observation   (y in pixels, p = K c in energy per pixel)
// Outputs: share         pixels squared
// Border rule: cliques that leave the image do not exist; reads are clamped to the image.


void kernel(ivec2 site)
{
    vec2 d = texelFetch(displacement, site, 0).xy;
    vec4 ratios_0 = texelFetch(straight, site, 0);
    vec4 ratios_1 = texelFetch(diagonal, site, 0);

    Evidence evidence = Evidence(vec2(0.0), vec2(0.0), 0.0);
    add_line(evidence, site, d, VERTICAL, weights[0], ratios_0.xy);
    add_line(evidence, site, d, HORIZONTAL, weights[1], ratios_0.zw);
    add_line(evidence, site, d, DIAGONAL, weights[2], ratios_1.xy);
    add_line(evidence, site, d, ANTIDIAGONAL, weights[3], ratios_1.zw);
    share = evidence.energy + observed(d, texelFetch(observation, site, 0));
}
