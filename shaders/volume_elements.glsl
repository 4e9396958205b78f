// Parameters of each element, from means over its sites; 0 if one of the sites is void.
//
//     PARAMETERS 1    mu = scale (sum of m over the eight sites)
//     PARAMETERS 2    mu = scale (sum of m) / (2 + 2 nu),    lambda = 2 mu nu / (1 - 2 nu)
//
// where nu is the mean of Poisson's ratio over the eight sites.
//
// Inputs:  stiffness  m, any unit; 0 in void
//          poisson    nu of each site, no unit, if PARAMETERS is 2
//          scale      factor that turns the sum into a mean, relative to the stiffest tissue
// Outputs: lame       mu, and lambda if PARAMETERS is 2, relative to the stiffest tissue
// Border rule: the border around the grid is void.

uniform double scale;

void kernel(int at)
{
    double sum = 0.0lf;
    double least = 1.0lf;
    double ratio = 0.0lf;
    for (int corner = 0; corner < 8; ++corner) {
        int site = at + (corner >> 2) * stride() + (corner >> 1 & 1) * pitch() + (corner & 1);
        double m = double(stiffness.at[site]);
        sum += m;
        least = min(least, m);
#if PARAMETERS == 2
        ratio += m > 0.0lf ? double(poisson.at[site]) : 0.0lf; // ratios in void may be invalid
#endif
    }
    double mu = least > 0.0lf ? scale * sum : 0.0lf;
#if PARAMETERS == 2
    ratio *= 0.125lf;
    mu /= 2.0lf + 2.0lf * ratio;
    lame[1].at[at] = float(2.0lf * mu * ratio / (1.0lf - 2.0lf * ratio));
#endif
    lame[0].at[at] = float(mu);
}
