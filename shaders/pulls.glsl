// What the paper's cliques answer to a displacement: A d, at a pair of sites.
//
//     A d = d - q(d) = - b / a                  by the cliques whose middle the site is
//     A d = - b, half the slope of the energy   with BLANKET, by all that contain it
//
// with a the curvature and b the slope of what the cliques say (cliques.glsl). Centred, the model is
// how far a site is from the weighted mean q of its neighbours: a length, and a diagonal of 1.
//
// Border rule: cliques that leave the image do not exist; a site that is in none has no answer.

// At the two sites of the pair.
vec2 force[2];

/// The answer at a site, number k of the middle row.
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

/// Find the answers at a pair: the first, or the one below the last.
void find_forces(ivec2 pair)
{
    look_around(pair);
    ivec2 site = first_of(clamped(pair, textureSize(displacement, 0)));
    force[0] = answer(site, 1);
    force[1] = answer(site + HORIZONTAL, 2);
}
