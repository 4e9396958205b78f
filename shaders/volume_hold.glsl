// The inverse of the finest level's diagonal; 0 where a component is held, or has no elements.
//
// Inputs:  inverse  the diagonal
//          pins     1 where a component is held, 0 elsewhere
// Outputs: inverse  its inverse
//          shares   the largest inverse: above 0 where something moves
// Border rule: none needed, a site reads its own values only.

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        float diagonal = inverse[k].at[at];
        bool moves = diagonal > 0.0 && pins[k].at[at] == 0.0;
        float value = moves ? 1.0 / diagonal : 0.0;
        inverse[k].at[at] = value;
        most = max(most, value);
    }
}
