// Colours of objects by category.
import { ink } from "./theme.js";

const KINDS = { car: 0, truck: 4, van: 5, bus: 4, pedestrian: 6, cyclist: 7 };
export const colourOf = ({ category }) => ink().lines[KINDS[category] ?? 0];
