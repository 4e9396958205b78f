// Cliques with a site at an end. These cliques and the cliques with the site in the middle
// (cliques.glsl) are all cliques that contain the site, as in the usual interpretation of eq. 7.
//
// Border rule: a clique with its middle outside the image does not exist, and reads are clamped.

#if BLANKET
/// Add the two cliques of a line; `ratios` is the texture with the ratios of that line.
void add_ends(
    inout Evidence evidence, ivec2 site, vec2 d, ivec2 line, vec2 weight, sampler2D ratios, bool second)
{
    ivec2 size = sites_of(displacement);
    for (int end = -1; end <= 1; end += 2) {
        ivec2 middle = site + end * line;
        vec4 both = texelFetch(ratios, clamped(middle, size), 0);
        vec2 ratio = second ? both.zw : both.xy;
        // The site is the end s of the clique if `end` > 0, otherwise the end u.
        ratio = end > 0 ? ratio : ratio.yx;
        ratio = in_image(middle, size) ? ratio : vec2(0.0);
        vec2 d_t = value_at(displacement, clamped(middle, size));
        vec2 d_far = value_at(displacement, clamped(middle + end * line, size));
        add_end(evidence, weight, ratio, d - d_t, d_far - d_t);
    }
}

/// Add all eight cliques with the site at an end; d is the displacement of the site.
void add_all_ends(inout Evidence evidence, ivec2 site, vec2 d)
{
    add_ends(evidence, site, d, VERTICAL, weights[0], straight, false);
    add_ends(evidence, site, d, HORIZONTAL, weights[1], straight, true);
    add_ends(evidence, site, d, DIAGONAL, weights[2], diagonal, false);
    add_ends(evidence, site, d, ANTIDIAGONAL, weights[3], diagonal, true);
}
#endif
