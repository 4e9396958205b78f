// Force of the paper's cliques at a pair of sites: A d of the linear model.
//
//     A d = d - q(d) = - b / a                     for cliques with the site in the middle
//     A d = - b, half the gradient of the energy   with BLANKET, for all cliques with the site
//
// with the curvature a and the slope b of the cliques (cliques.glsl). Without BLANKET, A d is the
// distance of a site from the minimum q of its local energy. In that case, A d is a length, and the
// diagonal of A is 1.
//
// Inputs:  displacement, straight, diagonal, weights  see cliques.glsl
// Border rule: cliques that extend beyond the image do not exist, and the force at a site without
// cliques is 0.

// Force at the two sites of the pair.
vec2 force[2];

/// Return the force at a site; k is its index in `here`.
vec2 answer(ivec2 site, int k)
{
    Evidence evidence = centred(site, k);
#if BLANKET
    add_all_ends(evidence, site, here[k]);
    return -evidence.slope;
#else
    return -evidence.slope / max(evidence.curvature, vec2(TINY));
#endif
}

/// Compute the forces at the first pair, or at the pair below the previous pair.
void find_forces(ivec2 pair)
{
    look_around(pair);
    ivec2 site = first_of(clamped(pair, textureSize(displacement, 0)));
    force[0] = answer(site, 1);
    force[1] = answer(site + HORIZONTAL, 2);
}
